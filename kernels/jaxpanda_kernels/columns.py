r"""The dynamics of one given arm, one column of samples for each number: unrolled, and folded to that arm.

The same equations as `dynamics`, written out as scalars. Each joint's position, velocity and acceleration
is an array of its own, `(samples,)`, or a row of `(dof, samples)`; results come as one array each. The
geometry is known while tracing, so that an arm pays nothing for its right angles and zeros.

Call these within `jit`, and keep what consumes the results out of reach of XLA's fusion, as `batched` does
with `staging.alone`: a `stack` behind them computes everything again for every element.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .chain import Chain
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
from .trigonometry import sincos

Columns: TypeAlias = Sequence[Scalar] | Float[Array, "dof ..."]


@dataclasses.dataclass(frozen=True)
class Geometry:
    """A chain as plain numbers: a value to hash and compare, so that one compilation serves equal chains."""

    R: tuple[Rows, ...]
    p: tuple[Vector, ...]
    prismatic: tuple[bool, ...]
    gravity: Vector

    @property
    def dof(self) -> int:
        return len(self.p)


def _floats(x: np.ndarray, scale: float) -> list:
    """`x` as floats; what rounding alone keeps from 0 or from `scale` is made that."""
    epsilon = 4 * float(np.finfo(x.dtype).eps) * scale
    for value in (0.0, scale, -scale):
        x = np.where(np.abs(x - value) <= epsilon, value, x)
    return x.astype(float).tolist()


def _vector(x: Sequence[float]) -> Vector:
    a, b, c = x
    return a, b, c


def _rows(x: Sequence[Sequence[float]]) -> Rows:
    a, b, c = x
    return _vector(a), _vector(b), _vector(c)


def specialise(chain: Chain) -> Geometry:
    """The numbers of a chain, to be folded into compiled programs.

    What only rounding keeps from 0 and ±1 is made that: a right angle given as pi/2 is folded too.

    Raises:
        jax.errors.TracerArrayConversionError: `chain` is traced; take the plain definitions in `dynamics`.
    """
    R, p, gravity = np.asarray(chain.R), np.asarray(chain.p), np.asarray(chain.gravity)
    return Geometry(
        tuple(_rows(x) for x in _floats(R, 1.0)),
        tuple(_vector(x) for x in _floats(p, float(np.abs(p).max(initial=0)) or 1.0)),
        tuple(np.asarray(chain.prismatic).tolist()),
        _vector(gravity.astype(float).tolist()),
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Joint:
    """Pose of a link in its parent: axes $R\\,R_z(q)$, the product not formed, and origin `r`."""

    R: Rows
    sine: Scalar
    cosine: Scalar
    r: Vector

    def inward(self, u: Vector) -> Vector:
        """A vector of the link, in its parent's axes."""
        x, y, z = u
        s, c = self.sine, self.cosine
        return apply(self.R, (sub(mul(c, x), mul(s, y)), add(mul(s, x), mul(c, y)), z))

    def outward(self, u: Vector) -> Vector:
        """A vector of the parent, in the link's axes."""
        x, y, z = apply(transpose(self.R), u)
        s, c = self.sine, self.cosine
        return add(mul(c, x), mul(s, y)), sub(mul(c, y), mul(s, x)), z


def joints(arm: Geometry, q: Columns) -> list[Joint]:
    poses = []
    for i in range(arm.dof):
        if arm.prismatic[i]:
            slide = times(q[i], transpose(arm.R[i])[2])
            poses.append(Joint(arm.R[i], 0.0, 1.0, plus(arm.p[i], slide)))
        else:
            poses.append(Joint(arm.R[i], *sincos(q[i]), arm.p[i]))
    return poses


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Motion:
    """Motion of a link's frame in its own axes; `a` is less gravity."""

    w: Vector
    dw: Vector
    a: Vector

    def spin(self) -> Rows:
        r"""$[\dot\omega]_\times + [\omega]_\times^2$: place on the link to acceleration over the origin's."""
        (x, y, z), (dx, dy, dz) = self.w, self.dw
        xx, yy, zz = mul(x, x), mul(y, y), mul(z, z)
        xy, xz, yz = mul(x, y), mul(x, z), mul(y, z)
        return (
            (negative(add(yy, zz)), sub(xy, dz), add(xz, dy)),
            (add(xy, dz), negative(add(xx, zz)), sub(yz, dx)),
            (sub(xz, dy), add(yz, dx), negative(add(xx, yy))),
        )


def motions(arm: Geometry, outward: Sequence[Joint], qd: Columns, qdd: Columns) -> list[Motion]:
    """Motion of every link, from the base outward."""
    gx, gy, gz = arm.gravity
    parent = Motion(ZERO, ZERO, (negative(gx), negative(gy), negative(gz)))
    moving = []
    for joint, prismatic, v, acceleration in zip(outward, arm.prismatic, qd, qdd, strict=True):
        w = joint.outward(parent.w)
        dw = joint.outward(parent.dw)
        a = joint.outward(plus(parent.a, apply(parent.spin(), joint.r)))
        coriolis = mul(v, w[1]), negative(mul(v, w[0]))  # qd (w × z)
        if prismatic:
            a = add(a[0], mul(2.0, coriolis[0])), add(a[1], mul(2.0, coriolis[1])), add(a[2], acceleration)
        else:
            w = w[0], w[1], add(w[2], v)
            dw = add(dw[0], coriolis[0]), add(dw[1], coriolis[1]), add(dw[2], acceleration)
        parent = Motion(w, dw, a)
        moving.append(parent)
    return moving


def _column(value: Scalar, like: Scalar) -> Float[Array, "*samples"]:
    shape = jnp.asarray(like)
    return jnp.broadcast_to(jnp.asarray(value, shape.dtype), shape.shape)


Body: TypeAlias = Sequence[Scalar]
"""A link's ten parameters, as in `inertia`."""


def _wrench(body: Body, motion: Motion) -> tuple[Vector, Vector]:
    """Force and moment about the link's origin that the motion of the link's own body takes."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = body
    h = hx, hy, hz
    M = motion.spin()
    (x, y, z), (dx, dy, dz) = motion.w, motion.dw
    force = plus(times(m, motion.a), apply(M, h))
    spinning = (  # I dω + ω × I ω
        add(
            mul(xx, dx),
            mul(sub(zz, yy), mul(y, z)),
            mul(xz, M[1][0]),
            negative(mul(xy, M[2][0])),
            mul(yz, sub(M[1][1], M[2][2])),
        ),
        add(
            mul(yy, dy),
            mul(sub(xx, zz), mul(x, z)),
            mul(xy, M[2][1]),
            negative(mul(yz, M[0][1])),
            mul(xz, sub(M[2][2], M[0][0])),
        ),
        add(
            mul(zz, dz),
            mul(sub(yy, xx), mul(x, y)),
            mul(yz, M[0][2]),
            negative(mul(xz, M[1][2])),
            mul(xy, sub(M[0][0], M[1][1])),
        ),
    )
    return force, plus(spinning, cross(h, motion.a))


def _seen_from_parent(joint: Joint, body: Body) -> Body:
    """The same body's ten parameters in the frame of the link's parent."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = body
    s, c = joint.sine, joint.cosine
    ss, cc, cs = mul(s, s), mul(c, c), mul(c, s)
    twice = mul(2.0, mul(cs, xy))
    turned_xy = add(mul(cs, sub(xx, yy)), mul(sub(cc, ss), xy))
    turned_xz, turned_yz = sub(mul(c, xz), mul(s, yz)), add(mul(s, xz), mul(c, yz))
    turned = (
        (sub(add(mul(cc, xx), mul(ss, yy)), twice), turned_xy, turned_xz),
        (turned_xy, add(mul(ss, xx), mul(cc, yy), twice), turned_yz),
        (turned_xz, turned_yz, zz),
    )
    A = transpose((apply(joint.R, turned[0]), apply(joint.R, turned[1]), apply(joint.R, turned[2])))  # R I
    B = apply(joint.R, A[0]), apply(joint.R, A[1]), apply(joint.R, A[2])  # R I Rᵀ
    x, y, z = joint.r
    h = joint.inward((hx, hy, hz))
    ex, ey, ez = plus(h, times(mul(0.5, m), joint.r))  # 2 e = old first moment + new
    moment = plus(h, times(m, joint.r))
    return (
        m,
        *moment,
        add(B[0][0], mul(2.0, add(mul(y, ey), mul(z, ez)))),
        sub(B[0][1], add(mul(x, ey), mul(y, ex))),
        add(B[1][1], mul(2.0, add(mul(x, ex), mul(z, ez)))),
        sub(B[0][2], add(mul(x, ez), mul(z, ex))),
        sub(B[1][2], add(mul(y, ez), mul(z, ey))),
        add(B[2][2], mul(2.0, add(mul(x, ex), mul(y, ey)))),
    )


def regrouped(arm: Geometry, bodies: Sequence[Body]) -> list[Body]:
    """Other bodies that take the same joint torques, with zeros where the joints cannot tell.

    Mass on the axis of a revolute joint may as well be fixed to the link before it, and so may the whole
    inertia of a link that slides: three parameters of each turning link become zero, six of each sliding one.

    References:
        Khalil and Kleinfinger, "Minimum Operations and Minimum Parameters of the Dynamic Models of Tree
        Structure Robots", 1987.
    """
    kept: list[Body] = []
    moved: Body = (0.0,) * 10
    for i in reversed(range(arm.dof)):
        m, hx, hy, hz, xx, xy, yy, xz, yz, zz = (add(a, b) for a, b in zip(bodies[i], moved, strict=True))
        if arm.prismatic[i]:
            kept.append((m, hx, hy, hz, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            moved = 0.0, 0.0, 0.0, 0.0, xx, xy, yy, xz, yz, zz
        else:
            kept.append((0.0, hx, hy, 0.0, sub(xx, yy), xy, 0.0, xz, yz, zz))
            moved = m, 0.0, 0.0, hz, yy, 0.0, yy, 0.0, 0.0, 0.0
        moved = _seen_from_parent(Joint(arm.R[i], 0.0, 1.0, arm.p[i]), moved)
    return kept[::-1]


@functools.cache
def regrouping(arm: Geometry) -> np.ndarray:
    """`regrouped` as the matrix that it multiplies the row of all parameters by, `(10 dof, 10 dof)`."""
    unit = np.eye(10 * arm.dof).reshape(-1, arm.dof, 10).tolist()
    images = [[value for body in regrouped(arm, bodies) for value in body] for bodies in unit]
    return np.asarray(images, float).T


def rnea(
    arm: Geometry, bodies: Sequence[Body], q: Columns, qd: Columns, qdd: Columns
) -> list[Float[Array, "*samples"]]:
    """Joint torques [N m; N where the joint slides]; as `dynamics.rnea`.

    Args:
        arm: what `specialise` made of the chain.
        bodies: ten numbers a link. Floats are folded in; arrays may be one number, or one a sample. Pass them
            through `regrouped` first: it saves a tenth of the arithmetic.
        q: positions, one column a joint.
        qd: velocities.
        qdd: accelerations.
    """
    outward = joints(arm, q)
    moving = motions(arm, outward, qd, qdd)
    force, moment = ZERO, ZERO
    tau = []
    for joint, prismatic, motion, body in reversed(
        list(zip(outward, arm.prismatic, moving, bodies, strict=True))
    ):
        own_force, own_moment = _wrench(body, motion)
        force, moment = plus(own_force, force), plus(own_moment, moment)
        tau.append(_column(force[2] if prismatic else moment[2], q[0]))
        force = joint.inward(force)
        moment = plus(joint.inward(moment), cross(joint.r, force))
    return tau[::-1]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Twist:
    """Unit motion of one joint as a link beyond it feels it: turn and slide of its frame, in its axes."""

    turn: Vector
    slide: Vector


def twists(arm: Geometry, outward: Sequence[Joint], i: int) -> list[Twist]:
    """Unit motion of joint `i` in the frames of link i and all beyond."""
    z = 0.0, 0.0, 1.0
    moving = [Twist(ZERO, z) if arm.prismatic[i] else Twist(z, ZERO)]
    for joint in outward[i + 1 :]:
        parent = moving[-1]
        slide = plus(parent.slide, cross(parent.turn, joint.r))
        moving.append(Twist(joint.outward(parent.turn), joint.outward(slide)))
    return moving


def _row(twist: Twist, motion: Motion) -> list[Scalar]:
    """Power of a joint's unit motion against a link that moves by `motion`: ten numbers times its `phi`."""
    t, l = twist.turn, twist.slide
    (x, y, z), (dx, dy, dz) = motion.w, motion.dw
    ux, uy, uz = cross(t, motion.w)  # t · (ω × I ω) = (t × ω) · I ω
    tx, ty, tz = t
    first = plus(apply(transpose(motion.spin()), l), cross(motion.a, t))
    return [
        dot(l, motion.a),
        *first,
        add(mul(tx, dx), mul(ux, x)),
        add(mul(tx, dy), mul(ty, dx), mul(ux, y), mul(uy, x)),
        add(mul(ty, dy), mul(uy, y)),
        add(mul(tx, dz), mul(tz, dx), mul(ux, z), mul(uz, x)),
        add(mul(ty, dz), mul(tz, dy), mul(uy, z), mul(uz, y)),
        add(mul(tz, dz), mul(uz, z)),
    ]


Entry: TypeAlias = tuple[int, int, int]
"""Row i, link l, parameter k of a regressor."""


def rows(
    arm: Geometry,
    outward: Sequence[Joint],
    moving: Sequence[Motion],
    which: Sequence[int],
    like: Scalar,
) -> dict[Entry, Float[Array, "*samples"]]:
    """Rows `which` of the regressor, from the joints and motions they rest on; columns shaped `like` that."""
    entries = {
        (i, l, k): value
        for i in which
        for l, (twist, motion) in enumerate(zip(twists(arm, outward, i), moving[i:], strict=True), start=i)
        for k, value in enumerate(_row(twist, motion))
    }
    return {entry: _column(value, like) for entry, value in entries.items() if not known(value, 0.0)}


def regressor(arm: Geometry, q: Columns, qd: Columns, qdd: Columns) -> dict[Entry, Float[Array, "*samples"]]:
    r"""Entries of $Y$ that are not zero for every motion of this arm; as `dynamics.regressor`.

    $Y_{il} \phi_l$ is the power that link l's inertial wrench takes from joint i turning at unit speed: the
    axis of joint i goes outward, six numbers a link, where a column of wrenches would come inward, sixty.
    """
    outward = joints(arm, q)
    return rows(arm, outward, motions(arm, outward, qd, qdd), range(arm.dof), q[0])


def mass_matrix(
    arm: Geometry, bodies: Sequence[Body], q: Columns
) -> dict[tuple[int, int], Float[Array, "*samples"]]:
    """Entries (i, j), i <= j, of the mass matrix [kg m²]; as `dynamics.mass_matrix`.

    References:
        Walker and Orin, "Efficient Dynamic Computer Simulation of Robotic Mechanisms", 1982.
    """
    outward = joints(arm, q)
    M = {}
    beyond: Body = (0.0,) * 10
    for j in reversed(range(arm.dof)):
        beyond = tuple(add(a, b) for a, b in zip(bodies[j], beyond, strict=True))
        m, hx, hy, _, _, _, _, xz, yz, zz = beyond
        if arm.prismatic[j]:
            force, moment = (0.0, 0.0, m), (hy, negative(hx), 0.0)
        else:
            force, moment = (negative(hy), hx, 0.0), (xz, yz, zz)
        for i in range(j, -1, -1):
            M[i, j] = _column(force[2] if arm.prismatic[i] else moment[2], q[0])
            force = outward[i].inward(force)
            moment = plus(outward[i].inward(moment), cross(outward[i].r, force))
        beyond = _seen_from_parent(outward[j], beyond)
    return M


def solve(
    M: dict[tuple[int, int], Float[Array, "*samples"]], b: Sequence[Float[Array, "*samples"]]
) -> list[Float[Array, "*samples"]]:
    r"""x with M x = b, for positive definite M given by its entries (i, j), i <= j; $M = U D U^\top$.

    Elimination starts at the last joint, whose row is the cheapest.
    """
    n = len(b)
    M, x = dict(M), list(b)
    for k in reversed(range(n)):
        for i in range(k):
            factor = M[i, k] / M[k, k]
            for j in range(i, k):
                M[i, j] = M[i, j] - factor * M[j, k]
            x[i] = x[i] - factor * x[k]
            M[i, k] = factor
    x = [x[k] / M[k, k] for k in range(n)]
    for k in range(n):
        for i in range(k):
            x[k] = x[k] - M[i, k] * x[i]
    return x
