"""What joints have alike is likelier at one more of them; what they do not is as likely at each."""

import itertools

import numpy as np
import pytest

from jaxpanda.effects.drive import Armature, JointSpring
from jaxpanda.effects.friction import CoulombFriction, ViscousFriction
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.sensing import TorqueOffset
from jaxpanda.effects.stribeck import StribeckFriction
from jaxpanda.inference.alike import TEMPERATURE, one_more, shared

DOF = 7


def odds(law, effects) -> float:
    """Log prior odds of one more, beside the others, its price for the place left out."""
    return law.prior + law.form_prior + shared((*effects, law), DOF) - shared(effects, DOF)


def bristles(j):
    return PreslidingHysteresis(j, 0.05, "dahl only")


@pytest.mark.parametrize("law", [lambda j: CoulombFriction(j, 0.01), ViscousFriction, Armature, bristles])
def test_the_first_joint_pays_in_full_and_each_further_one_less(law):
    told = [odds(law(k), [law(j) for j in range(k)]) for k in range(DOF)]
    assert told[0] == law(0).prior
    assert told[1] == pytest.approx(-TEMPERATURE * np.log(DOF - 1))
    assert all(a <= b for a, b in itertools.pairwise(told))
    assert told[-1] == 0.0  # never likelier beforehand than not: what nothing shows is not there


def test_of_fewer_joints_that_could_show_a_law_one_more_is_likelier():
    one, more = CoulombFriction(0, 0.01), CoulombFriction(3, 0.01)
    gained = [shared((one, more), joints) for joints in (7, 4, 3, 2)]
    assert all(a < b for a, b in itertools.pairwise(gained))
    assert gained[-1] == -CoulombFriction.prior  # the only other joint that moves has it


def test_the_order_in_which_joints_are_found_does_not_matter():
    effects = [
        CoulombFriction(0, 0.01),
        StribeckFriction(3, 0.05, 0.01, 2.0, form="whole"),
        StribeckFriction(5, 0.05, 0.01, 2.0, form="viscous"),
        ViscousFriction(0),
    ]
    told = {round(shared(order, DOF), 9) for order in itertools.permutations(effects)}
    assert len(told) == 1
    assert told.pop() > 0


def test_a_law_counts_with_the_parts_that_it_holds():
    """Stribeck's curve holds a Coulomb level: found at one joint, it makes that of another likelier."""
    curve = StribeckFriction(3, 0.05, 0.01, 2.0, form="whole")
    assert odds(CoulombFriction(1, 0.01), [curve]) == odds(
        CoulombFriction(1, 0.01), [CoulombFriction(3, 0.01)]
    )
    assert odds(ViscousFriction(1), [curve]) == ViscousFriction.prior


def test_what_each_joint_has_of_its_own_is_not_shared():
    for kind in (lambda j: JointSpring(j, "linear"), TorqueOffset):
        one, *others = (kind(j) for j in range(DOF))
        assert odds(one, others) == one.prior + one.form_prior


def test_dry_friction_that_sticks_is_coulombs():
    """Whatever its law builds up over: beside it, Coulomb's is as much likelier as beside itself."""
    sticking = PreslidingHysteresis(3, 1e-3, "dahl only")
    assert sticking.title == CoulombFriction.name
    coulomb = CoulombFriction(1, 0.01)
    assert odds(coulomb, [sticking]) == odds(coulomb, [CoulombFriction(3, 0.01)])


def test_a_curve_is_shared_as_far_as_its_lines_are():
    """What a curve adds must be borne out in each joint."""
    curve = lambda j: StribeckFriction(j, 0.05, 0.01, 2.0, form="viscous")
    others = [curve(j) for j in range(DOF - 1)]
    assert odds(curve(DOF - 1), others) == StribeckFriction.prior


def test_the_same_joint_twice_is_no_second_joint():
    assert shared([CoulombFriction(2, 0.01), StribeckFriction(2, 0.05, 0.01, 2.0, form="whole")], DOF) == 0.0


def test_one_more_effect_is_worth_what_it_adds_to_all():
    everything = [
        *(CoulombFriction(j, 0.01) for j in (0, 2, 3)),
        *(StribeckFriction(j, 0.05, 0.01, 2.0, form="whole") for j in (2, 4)),
        *(
            PreslidingHysteresis(j, x, form)
            for j, x, form in ((0, 0.05, "dahl only"), (4, 1e-3, "dahl whole"))
        ),
        TorqueOffset(3),
        Armature(5),
    ]
    for count in range(len(everything)):
        held = everything[:count]
        beside = one_more(held, DOF)
        for effect in everything:
            assert beside(effect) == pytest.approx(
                shared((*held, effect), DOF) - shared(held, DOF), abs=1e-12
            )
