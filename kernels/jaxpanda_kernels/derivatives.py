r"""How torque and acceleration of one given arm change with its state, analytically, for many samples at once.

With $\tau = \mathrm{ID}(q, \dot q, \ddot q)$ and $\ddot q = \mathrm{FD}(q, \dot q, \tau)$, row i and column j
of each result is the derivative of joint i's torque (or acceleration) in what of joint j.

`plain_inverse` and `plain_forward` are the definition, for one sample and any chain as data. `inverse` and
`forward` give the same for one fixed chain and any leading shape, as `batched` does: unrolled, the geometry
folded in. `entries` and `forward_entries` give columns, without the zeros and without the transposition, which
costs more than the arithmetic.

A joint's turn moves all links from its own on as one body, seen from the joints before it. What it does to
their acceleration is a rigid field $\ddot\psi$ and a Coriolis term $2\,\omega' \times u$ in the velocity u of
each particle, so that one composite body a joint, with its momentum and the moments of that momentum, answers
for all links beyond:

$$\partial\tau_i/\partial q_j = s_i \cdot (I_j \ddot\psi_j + G_j \omega'_j + s_j \times^* f_j), \qquad
  \partial\tau_j/\partial q_i = s_j \cdot (I_j \ddot\psi_i + G_j \omega'_i), \qquad i \le j$$

References:
    Singh, Russell, Wensing, "Efficient Analytical Derivatives of Rigid-Body Dynamics using Spatial Vector
    Algebra", RA-L 2022, in whose terms $G = 2B$.
    Carpentier and Mansard, "Analytical Derivatives of Rigid Body Dynamics Algorithms", RSS 2018.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import batched, columns, dynamics
from .chain import Chain
from .columns import Body, Columns, Geometry, Joint, Motion, Twist
from .scalars import (
    ZERO,
    Rows,
    Scalar,
    Vector,
    add,
    apply,
    cross,
    dot,
    known,
    mul,
    negative,
    plus,
    sub,
    times,
    transpose,
)
from .staging import Stage, alone, in_chunks, in_registers

Z: Vector = (0.0, 0.0, 1.0)


class Inverse(NamedTuple):
    """Derivatives of inverse dynamics."""

    q: Float[Array, "*samples dof dof"]
    """In positions [N m/rad]."""
    qd: Float[Array, "*samples dof dof"]
    """In velocities [N m s/rad]."""
    qdd: Float[Array, "*samples dof dof"]
    """In accelerations: the mass matrix [kg m²]."""


class Forward(NamedTuple):
    """Derivatives of forward dynamics."""

    q: Float[Array, "*samples dof dof"]
    """In positions [1/s²]."""
    qd: Float[Array, "*samples dof dof"]
    """In velocities [1/s]."""
    tau: Float[Array, "*samples dof dof"]
    """In torques: the inverse of the mass matrix with armature [1/(kg m²)]."""


def plain_inverse(
    chain: Chain,
    phi: Float[Array, "dof 10"],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    qdd: Float[Array, " dof"],
) -> Inverse:
    """Derivatives of `dynamics.rnea` at one sample, by forward differentiation: the definition."""
    torque = functools.partial(dynamics.rnea, chain, phi)
    return Inverse(*jax.jacfwd(torque, (0, 1, 2))(q, qd, qdd))


def plain_forward(
    chain: Chain,
    phi: Float[Array, "dof 10"],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    tau: Float[Array, " dof"],
    armature: Float[Array, " dof"],
) -> Forward:
    """Derivatives of `dynamics.forward_dynamics` at one sample, by forward differentiation: the definition."""

    def acceleration(q, qd, tau):
        return dynamics.forward_dynamics(chain, phi, q, qd, tau, armature)

    return Forward(*jax.jacfwd(acceleration, (0, 1, 2))(q, qd, tau))


# --- columns of samples ---


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shift:
    """What a joint's motion does to the links from its own on: fields at its origin, in its link's axes."""

    unit: Twist
    """The joint's own unit motion, s."""
    velocity: Twist
    r"""$\psi'$: change of velocity with the joint's position; its turn is $\omega'$."""
    acceleration: Twist
    r"""$\ddot\psi$: change of acceleration with it, beside $2\,\omega' \times u$."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Moving:
    """A link's motion, its origin's velocity in the base's frame, and what its joint's motion does."""

    motion: Motion
    v: Vector
    shift: Shift


def moving_links(arm: Geometry, outward: Sequence[Joint], qd: Columns, qdd: Columns) -> list[Moving]:
    """Motion of every link and the fields of its joint, from the base outward."""
    gx, gy, gz = arm.gravity
    parent, v = Motion(ZERO, ZERO, (negative(gx), negative(gy), negative(gz))), ZERO
    links = []
    for joint, prismatic, speed, acceleration in zip(outward, arm.prismatic, qd, qdd, strict=True):
        v = joint.outward(plus(v, cross(parent.w, joint.r)))
        a = joint.outward(plus(parent.a, apply(parent.spin(), joint.r)))
        w, dw = joint.outward(parent.w), joint.outward(parent.dw)
        turned = cross(w, Z)
        coriolis = times(speed, turned)
        if prismatic:
            rise = plus(cross(dw, Z), cross(w, turned))
            shift = Shift(Twist(ZERO, Z), Twist(ZERO, turned), Twist(ZERO, rise))
            a = add(a[0], mul(2.0, coriolis[0])), add(a[1], mul(2.0, coriolis[1])), add(a[2], acceleration)
            v = v[0], v[1], add(v[2], speed)
        else:
            turn = plus(cross(dw, Z), cross(w, turned))
            slide = plus(cross(a, Z), times(2.0, cross(v, turned)))
            shift = Shift(Twist(Z, ZERO), Twist(turned, cross(v, Z)), Twist(turn, slide))
            w = w[0], w[1], add(w[2], speed)
            dw = add(dw[0], coriolis[0]), add(dw[1], coriolis[1]), add(dw[2], acceleration)
        parent = Motion(w, dw, a)
        links.append(Moving(parent, v, shift))
    return links


Wrench: TypeAlias = tuple[Vector, Vector]
"""Force, and moment about a link's origin."""


def _inward(joint: Joint, wrench: Wrench) -> Wrench:
    force = joint.inward(wrench[0])
    return force, plus(joint.inward(wrench[1]), cross(joint.r, force))


def _against(twist: Twist, wrench: Wrench) -> Scalar:
    return add(dot(twist.slide, wrench[0]), dot(twist.turn, wrench[1]))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Composite:
    r"""A link and all beyond it as one body, about the link's origin, in its axes."""

    body: Body
    """Ten numbers, as in `inertia`."""
    P: Vector
    r"""Twice the momentum, $2 \sum m u$."""
    G: Rows
    r"""Twice $\mathrm{tr}(D)\,1 - D^\top$ with $D = \sum m\,x\,u^\top$.

    $G\omega' = \sum x \times 2m\,(\omega' \times u)$.
    """
    wrench: Wrench
    """What the motion takes."""

    def plus(self, other: "Composite") -> "Composite":
        a, b, c = (plus(x, y) for x, y in zip(self.G, other.G, strict=True))
        (f, n), (g, m) = self.wrench, other.wrench
        return Composite(
            tuple(add(x, y) for x, y in zip(self.body, other.body, strict=True)),
            plus(self.P, other.P),
            (a, b, c),
            (plus(f, g), plus(n, m)),
        )

    def seen_from_parent(self, joint: Joint) -> "Composite":
        P = joint.inward(self.P)
        a, b, c = (joint.inward(row) for row in self.G)
        x, y, z = (joint.inward(column) for column in transpose((a, b, c)))
        a, b, c = transpose((x, y, z))
        trace = dot(joint.r, P)
        rx, ry, rz = joint.r
        G = (
            (sub(add(a[0], trace), mul(P[0], rx)), sub(a[1], mul(P[0], ry)), sub(a[2], mul(P[0], rz))),
            (sub(b[0], mul(P[1], rx)), sub(add(b[1], trace), mul(P[1], ry)), sub(b[2], mul(P[1], rz))),
            (sub(c[0], mul(P[2], rx)), sub(c[1], mul(P[2], ry)), sub(add(c[2], trace), mul(P[2], rz))),
        )
        return Composite(columns._seen_from_parent(joint, self.body), P, G, _inward(joint, self.wrench))

    def force(self, field: Twist) -> Wrench:
        """What a rigid field of acceleration takes."""
        m, hx, hy, hz, xx, xy, yy, xz, yz, zz = self.body
        h, t, l = (hx, hy, hz), field.turn, field.slide
        I = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        return plus(times(m, l), cross(t, h)), plus(apply(I, t), cross(h, l))


def _own(body: Body, link: Moving) -> Composite:
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = body
    h, (vx, vy, vz) = (hx, hy, hz), link.v
    x, y, z = link.motion.w
    # tr(I) 1 - 2 I, twice the second moment: its columns crossed with w are the angular part of G
    sxx, syy, szz = sub(add(yy, zz), xx), sub(add(xx, zz), yy), sub(add(xx, yy), zz)
    sxy, sxz, syz = mul(-2.0, xy), mul(-2.0, xz), mul(-2.0, yz)
    spun = tuple(cross(column, (x, y, z)) for column in ((sxx, sxy, sxz), (sxy, syy, syz), (sxz, syz, szz)))
    h2x, h2y, h2z = times(2.0, h)
    a, b, c = transpose((spun[0], spun[1], spun[2]))
    xv, yv, zv = mul(h2x, vx), mul(h2y, vy), mul(h2z, vz)
    G = (
        (add(a[0], yv, zv), sub(a[1], mul(h2y, vx)), sub(a[2], mul(h2z, vx))),
        (sub(b[0], mul(h2x, vy)), add(b[1], xv, zv), sub(b[2], mul(h2z, vy))),
        (sub(c[0], mul(h2x, vz)), sub(c[1], mul(h2y, vz)), add(c[2], xv, yv)),
    )
    P = plus(times(mul(2.0, m), link.v), cross(link.motion.w, (h2x, h2y, h2z)))
    return Composite(body, P, G, columns._wrench(body, link.motion))


def _composite(body: Body, link: Moving, beyond: Composite | None, joint: Joint | None) -> Composite:
    """Of a link, from that of the next and the next joint."""
    own = _own(body, link)
    return own if beyond is None or joint is None else own.plus(beyond.seen_from_parent(joint))


Pair: TypeAlias = tuple[str, int, int]
"""Derivative of joint i's torque in what of joint j: ("q", i, j)."""


def of_joint(
    arm: Geometry, outward: Sequence[Joint], shifts: Sequence[Shift], composite: Composite, j: int
) -> dict[Pair, Scalar]:
    """Derivatives between joint j and those before it, both ways, from the composite body beyond j."""
    shift, (f, n) = shifts[j], composite.wrench
    w1 = shift.velocity.turn
    unit = composite.force(shift.unit)
    force, moment = composite.force(shift.acceleration)
    by_q = (
        plus(force, cross(w1, composite.P), cross(shift.unit.turn, f)),
        plus(moment, apply(composite.G, w1), cross(shift.unit.turn, n), cross(shift.unit.slide, f)),
    )
    twice = Twist(times(2.0, shift.velocity.turn), times(2.0, shift.velocity.slide))
    force, moment = composite.force(twice)
    by_qd = (
        plus(force, cross(shift.unit.turn, composite.P)),
        plus(moment, apply(composite.G, shift.unit.turn)),
    )
    back = plus(apply(transpose(composite.G), shift.unit.turn), cross(composite.P, shift.unit.slide))
    found: dict[Pair, Scalar] = {}
    for i in range(j, -1, -1):
        s = shifts[i]
        found["qdd", i, j] = _against(s.unit, unit)
        found["q", i, j] = _against(s.unit, by_q)
        found["qd", i, j] = _against(s.unit, by_qd)
        if i < j:
            found["qdd", j, i] = found["qdd", i, j]
            found["q", j, i] = add(_against(s.acceleration, unit), dot(s.velocity.turn, back))
            found["qd", j, i] = add(mul(2.0, _against(s.velocity, unit)), dot(s.unit.turn, back))
        unit, by_q, by_qd = (_inward(outward[i], x) for x in (unit, by_q, by_qd))
        back = outward[i].inward(back)
    return {pair: value for pair, value in found.items() if not known(value, 0.0)}


def _here(f: Callable, *arguments):
    return f(*arguments)


def of_columns(
    arm: Geometry, bodies: Sequence[Body], q: Columns, qd: Columns, qdd: Columns, stage: Stage = _here
) -> dict[Pair, Float[Array, "*samples"]]:
    """Derivatives that are not zero for every motion; as `inverse`.

    Args:
        arm: what `columns.specialise` made of the chain.
        bodies: ten numbers a link, best through `columns.regrouped`.
        q: positions, one column a joint.
        qd: velocities.
        qdd: accelerations.
        stage: calls a part of the program; `staging.in_chunks` gives one that keeps XLA from fusing across it.
    """
    outward = stage(functools.partial(columns.joints, arm), list(q))
    links = stage(functools.partial(moving_links, arm), outward, list(qd), list(qdd))
    shifts = [link.shift for link in links]
    found: dict[Pair, Scalar] = {}
    composite, joint = None, None
    for j in reversed(range(arm.dof)):
        composite = stage(_composite, bodies[j], links[j], composite, joint)
        joint = outward[j]
        before = outward[: j + 1], shifts[: j + 1]
        found |= stage(lambda o, s, c, j=j: of_joint(arm, o, s, c, j), *before, composite)
    return {pair: columns._column(value, q[0]) for pair, value in sorted(found.items())}


def inverse_of(
    M: dict[tuple[int, int], Float[Array, "*samples"]], stage: Stage = _here
) -> list[list[Float[Array, "*samples"]]]:
    """The inverse of a positive definite matrix given by its entries (i, j), i <= j: by the sweep operator.

    References:
        Goodnight, "A Tutorial on the SWEEP Operator", The American Statistician 1979.
    """
    n = 1 + max(j for _, j in M)

    def swept(M, k):
        scale = 1 / M[k, k]
        row = [M[min(i, k), max(i, k)] for i in range(n)]
        found = {(i, j): x - scale * row[i] * row[j] for (i, j), x in M.items() if k not in (i, j)}
        found |= {(min(i, k), max(i, k)): scale * row[i] for i in range(n)}
        return found | {(k, k): -scale}

    for k in reversed(range(n)):
        M = stage(functools.partial(swept, k=k), M)
    return [[-M[min(i, j), max(i, j)] for j in range(n)] for i in range(n)]


def accelerations(
    arm: Geometry,
    bodies: Sequence[Body],
    q: Columns,
    qd: Columns,
    tau: Columns,
    armature: Sequence[Scalar],
    stage: Stage = _here,
) -> tuple[Sequence[Sequence[Scalar]], Sequence[Scalar]]:
    r"""The inverse of the mass matrix with armature, and the acceleration; arguments as in `of_columns`."""
    M = stage(functools.partial(columns.mass_matrix, arm), bodies, list(q))
    h = stage(lambda b, x, v: columns.rnea(arm, b, x, v, [0.0] * arm.dof), bodies, list(q), list(qd))
    M |= {(i, i): M[i, i] + rotor for i, rotor in enumerate(armature)}
    inverse = inverse_of(M, stage)
    return inverse, stage(
        lambda A, t, h: _product(A, [sub(a, b) for a, b in zip(t, h, strict=True)]), inverse, list(tau), h
    )


def _product(A: Sequence[Sequence[Scalar]], x: Sequence[Scalar]) -> list[Scalar]:
    return [add(*(mul(a, b) for a, b in zip(row, x, strict=True))) for row in A]


def through(
    inverse: Sequence[Sequence[Scalar]], torque: Mapping[Pair, Scalar], what: str, stage: Stage = _here
) -> dict[Pair, Scalar]:
    r"""$-M^{-1}\,\partial\tau$, the change of acceleration in one of "q" and "qd", less columns of zeros."""
    dof = range(len(inverse))
    found: dict[Pair, Scalar] = {}
    for j in dof:
        column = [torque.get((what, i, j), 0.0) for i in dof]
        if not all(isinstance(x, float) for x in column):
            change = stage(_product, inverse, [negative(x) for x in column])
            found |= {(what, i, j): change[i] for i in dof}
    return found


# --- many samples ---

CHUNK = 256
"""Samples at a time on a CPU."""
GROUPS = 3
"""Programs on a GPU, of which each does what all need: its registers do not hold more results."""


def _chunked(f: Callable, *states: Sequence[Float[Array, " samples"]]):
    """`f(stage, *states)` in chunks, on a CPU, filled up with samples at rest."""
    count = states[0][0].shape[0]
    size = min(CHUNK, count + -count % 8) or 1
    filled = [[jnp.pad(x, (0, -count % size)) for x in state] for state in states]
    return jax.tree.map(lambda x: x[:count], in_chunks(f, size, *filled))


def entries(
    chain: Chain | Geometry, phi: Float[Array, "dof 10"], q: Columns, qd: Columns, qdd: Columns
) -> dict[Pair, Float[Array, " samples"]]:
    """Derivatives of inverse dynamics that are not zero for every motion, a column of samples each.

    ("q", i, j) is that of joint i's torque in joint j's position; "qd" velocity, "qdd" acceleration, of which
    only i <= j are given: the mass matrix is symmetric. On a GPU, outside `jit`, several programs one after the
    other. Best with a multiple of `CHUNK` samples on a CPU, with an odd number on a GPU.

    Args:
        chain: the arm, or what `columns.specialise` made of it.
        phi: inertial parameters, as in `inertia`.
        q: positions [rad or m], one column a joint.
        qd: velocities.
        qdd: accelerations.
    """
    arm = batched._geometry(chain)
    states = list(q), list(qd), list(qdd)
    if jax.default_backend() == "cpu":
        return _entries(arm, phi, *states)
    return _in_groups(arm, phi, *states, GROUPS)


def forward_entries(
    chain: Chain | Geometry,
    phi: Float[Array, "dof 10"],
    q: Columns,
    qd: Columns,
    tau: Columns,
    armature: Float[Array, " dof"],
) -> dict[Pair, Float[Array, " samples"]]:
    """Derivatives of forward dynamics that are not zero for every motion; as `entries`.

    ("q", i, j) is that of joint i's acceleration in joint j's position; "qd" velocity; "tau" torque, i <= j.

    Args:
        chain: the arm, or what `columns.specialise` made of it.
        phi: inertial parameters, as in `inertia`.
        q: positions [rad or m], one column a joint.
        qd: velocities.
        tau: torques [N m].
        armature: of each joint [kg m²].
    """
    arm = batched._geometry(chain)
    states = list(q), list(qd), list(tau)
    if jax.default_backend() == "cpu":
        return _forward_entries(arm, phi, *states, armature)
    inverse, qdd = _accelerations(arm, phi, *states, armature)
    torque = _in_groups(arm, phi, states[0], states[1], qdd, GROUPS, mass=False)
    return _upper(inverse) | _through(inverse, torque, "q") | _through(inverse, torque, "qd")


@functools.partial(jax.jit, static_argnums=0)
def _entries(arm: Geometry, phi, q, qd, qdd):
    bodies = batched._bodies(arm, phi, q[0])

    def all_of(stage, q, qd, qdd):
        return _told(of_columns(arm, bodies, q, qd, qdd, stage))

    return _chunked(all_of, q, qd, qdd)


def _told(found: dict[Pair, Any], mass: bool = True) -> dict[Pair, Any]:
    return {(what, i, j): x for (what, i, j), x in found.items() if what != "qdd" or (mass and i <= j)}


@functools.cache
def _groups(arm: Geometry, count: int, mass: bool) -> tuple[tuple[Pair, ...], ...]:
    """Pairs in groups of about one size, those of one joint's composite body together."""
    state, bodies = [jax.ShapeDtypeStruct((), jnp.float32)] * arm.dof, [(1.0,) * 10] * arm.dof
    found = jax.eval_shape(functools.partial(of_columns, arm, bodies), state, state, state)
    ordered = sorted(_told(found, mass), key=lambda pair: (-max(pair[1:]), pair))
    size = -(-len(ordered) // count)
    return tuple(tuple(ordered[i : i + size]) for i in range(0, len(ordered), size))


def _program(f: Callable, *arguments):
    return (in_registers if jax.default_backend() == "gpu" else alone)(f, *arguments)


def _in_groups(arm: Geometry, phi, q, qd, qdd, count: int, mass: bool = True, program: Callable = _program):
    every = [_some(arm, group, program, phi, q, qd, qdd) for group in _groups(arm, count, mass)]
    return {pair: column for group in every for pair, column in group.items()}


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _some(arm: Geometry, group: tuple[Pair, ...], program: Callable, phi, q, qd, qdd):
    def chosen(bodies, q, qd, qdd):
        found = of_columns(arm, bodies, q, qd, qdd)
        return {pair: found[pair] for pair in group}

    return program(chosen, batched._bodies(arm, phi, q[0]), q, qd, qdd)


@functools.partial(jax.jit, static_argnums=0)
def _forward_entries(arm: Geometry, phi, q, qd, tau, armature):
    bodies, rotors = batched._bodies(arm, phi, q[0]), list(armature.astype(q[0].dtype))

    def all_of(stage, q, qd, tau):
        inverse, qdd = accelerations(arm, bodies, q, qd, tau, rotors, stage)
        torque = of_columns(arm, bodies, q, qd, qdd, stage)
        return _upper(inverse) | through(inverse, torque, "q", stage) | through(inverse, torque, "qd", stage)

    return _chunked(all_of, q, qd, tau)


@functools.partial(jax.jit, static_argnums=0)
def _accelerations(arm: Geometry, phi, q, qd, tau, armature):
    rotors = list(armature.astype(q[0].dtype))
    return _program(
        functools.partial(accelerations, arm), batched._bodies(arm, phi, q[0]), q, qd, tau, rotors
    )


@functools.partial(jax.jit, static_argnums=2)
def _through(inverse, torque, what):
    return _program(lambda a, b: through(a, b, what), inverse, torque)


def _upper(inverse: Sequence[Sequence[Scalar]]) -> dict[Pair, Scalar]:
    return {("tau", i, j): inverse[i][j] for i in range(len(inverse)) for j in range(i, len(inverse))}


def _matrices(found: dict[Pair, Float[Array, " filled"]], what: str, like: Float[Array, "*samples dof"]):
    dof = like.shape[-1]
    zero = jnp.zeros_like(next(iter(found.values())))
    mirrored = found | {(w, j, i): x for (w, i, j), x in found.items() if w in ("qdd", "tau")}
    every = [mirrored.get((what, i, j), zero) for i in range(dof) for j in range(dof)]
    return batched._samples(every, (*like.shape, dof))


def inverse(
    chain: Chain | Geometry,
    phi: Float[Array, "dof 10"],
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    qdd: Float[Array, "*samples dof"],
) -> Inverse:
    """`plain_inverse` for every sample. Single entries are cheaper by `entries`.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    return _inverse(batched._geometry(chain, q, qd, qdd), phi, q, qd, qdd)


@functools.partial(jax.jit, static_argnums=0)
def _inverse(arm: Geometry, phi, q, qd, qdd):
    found = entries(arm, phi, *map(batched._columns, (q, qd, qdd)))
    return Inverse(*(_matrices(found, what, q) for what in Inverse._fields))


def forward(
    chain: Chain | Geometry,
    phi: Float[Array, "dof 10"],
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    tau: Float[Array, "*samples dof"],
    armature: Float[Array, " dof"],
) -> Forward:
    """`plain_forward` for every sample. Single entries are cheaper by `forward_entries`.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    return _forward(batched._geometry(chain, q, qd, tau), phi, q, qd, tau, armature)


@functools.partial(jax.jit, static_argnums=0)
def _forward(arm: Geometry, phi, q, qd, tau, armature):
    angles, speeds, torques = map(batched._columns, (q, qd, tau))
    found = forward_entries(arm, phi, angles, speeds, torques, armature)
    return Forward(*(_matrices(found, what, q) for what in Forward._fields))
