r"""What an arm can run into: itself, a floor, the user's scene. MuJoCo's geometry, and a smooth guide to it.

MuJoCo's C engine judges (`mj_geomDistance` of every pair that could touch, along the whole motion). It has no
gradients for JAX, so a motion is *sought* with a stand-in: one geom of a pair is covered by spheres, the other is
a rounded box that contains it,

$$d(p) = \lVert \max(|p| - h, 0)\rVert + \min(\max_i(|p_i| - h_i), 0) - r$$

exact for planes, spheres, capsules (where they are the box) and boxes, and on the safe side for the rest.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxpanda_kernels import Chain, link_poses
from jaxtyping import Array, Float, Int

from ..arms.arm import Arm
from ..arms.engine_log import own_log
from ..arms.mjcf import MjcfSource, with_shapes
from ..errors import InputError, reason
from .limits import is_franka_panda, published

CLEARANCE = 0.05
"""That a motion keeps from what it could run into, where nobody says another [m]."""
_STEP = 0.005
"""What may happen between two looks at a pair [m]."""
_POSES = 300
"""Random poses that show which pairs could touch."""
_ALWAYS = 0.95
"""Share of them in which a pair that is part of the arm's build is closer than the clearance."""
_NEAR = 0.15
"""Pairs that never come closer [m] are left to the final check."""
_SPHERES = 8
"""That cover a geom, at most."""
_PLANE, _HFIELD = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)
_FLOOR = "floor (assumed)"


class Probes(eqx.Module):
    """Spheres of one geom against the rounded box of another; link -1 stands still."""

    link_a: Int[Array, " probe"]
    centre: Float[Array, "probe 3"]
    """Of the sphere, in the frame of its link [m]."""
    radius: Float[Array, " probe"]
    link_b: Int[Array, " probe"]
    R: Float[Array, "probe 3 3"]
    """Axes of the box in the frame of its link."""
    p: Float[Array, "probe 3"]
    half: Float[Array, "probe 3"]
    """[m]"""
    rounding: Float[Array, " probe"]
    """[m]"""
    clearance: Float[Array, ""]
    """[m]"""

    def shortfall(self, chain: Chain, q: Float[Array, "time dof"]) -> Float[Array, "time probe"]:
        """Clearance less distance [m]; above zero is too close."""
        R, p = jax.vmap(lambda one: link_poses(chain, one))(q)
        R = jnp.concatenate([R, jnp.broadcast_to(jnp.eye(3), (len(q), 1, 3, 3))], 1)
        p = jnp.concatenate([p, jnp.zeros((len(q), 1, 3))], 1)  # link -1, the world, comes last
        a, b = self.link_a, self.link_b
        at = p[:, a] + jnp.einsum("tpik,pk->tpi", R[:, a], self.centre) - p[:, b]
        local = jnp.einsum("tpki,tpk->tpi", R[:, b], at) - self.p
        outside = jnp.abs(jnp.einsum("pki,tpk->tpi", self.R, local)) - self.half
        beyond = jnp.maximum(outside, 0.0)
        length = jnp.sqrt(jnp.sum(beyond**2, -1) + 1e-12)
        inside = jnp.minimum(outside.max(-1), 0.0)
        return self.clearance + self.radius + self.rounding - length - inside


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms that must not come close."""

    a: int
    b: int


@dataclasses.dataclass(frozen=True)
class Closest:
    """Where a motion comes closest to something."""

    distance: float
    """[m]; infinite where there is nothing to run into."""
    pair: str
    time: float
    """[s]"""

    def to_json(self) -> dict[str, object]:
        known = np.isfinite(self.distance)
        return {"distance": self.distance if known else None, "pair": self.pair, "time": self.time}


@dataclasses.dataclass(frozen=True)
class Scene:
    """An arm among things, in MuJoCo, and the pairs of geoms that could touch."""

    model: mujoco.MjModel
    source: MjcfSource
    pairs: tuple[Pair, ...]
    owner: Int[np.ndarray, " body"]
    """Link that carries each body; -1 for what stands still."""
    clearance: float
    """[m]"""
    notes: tuple[str, ...]

    def name(self, geom: int) -> str:
        """Of a geom, with its body."""
        body = self.model.body(self.model.geom_bodyid[geom]).name or "world"
        own = self.model.geom(geom).name
        return f"{body} ({own})" if own and own != body else body

    def distances(
        self, data: mujoco.MjData, q: Float[np.ndarray, " dof"], pairs: Sequence[Pair], most: float
    ) -> Float[np.ndarray, " pair"]:
        """Between pairs at one pose [m], by MuJoCo; `most` where it is larger."""
        data.qpos[[link.qpos for link in self.source.links]] = q
        mujoco.mj_kinematics(self.model, data)
        return np.array(
            [mujoco.mj_geomDistance(self.model, data, pair.a, pair.b, most, None) for pair in pairs]
        )

    def closest(
        self, time: Float[np.ndarray, " time"], q: Float[np.ndarray, "time dof"], speed: float
    ) -> Closest:
        """The smallest distance along a motion, by MuJoCo at every sample where it could be the smallest.

        Args:
            time: [s]
            q: positions, sampled so finely that what happens between does not matter.
            speed: that no two points of arm and scene exceed towards each other [m/s]; a pair that is far is
                looked at again when it could have become near.
        """
        data, dt = mujoco.MjData(self.model), float(time[1] - time[0])
        due = np.zeros(len(self.pairs), int)
        best = Closest(np.inf, "", 0.0)
        for k in range(len(time)):
            at = np.flatnonzero(due <= k)
            if not len(at):
                continue
            d = self.distances(data, q[k], [self.pairs[i] for i in at], 10.0)
            least = int(np.argmin(d))
            if d[least] < best.distance:
                pair = self.pairs[at[least]]
                best = Closest(
                    float(d[least]), f"{self.name(pair.a)} and {self.name(pair.b)}", float(time[k])
                )
            due[at] = k + 1 + np.floor(np.maximum(d - best.distance, 0) / (speed * dt + 1e-12)).astype(int)
        return best

    def distance_kept(self, arm: Arm, q: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, " pair"]:
        """How near each pair comes along a motion, at most the clearance [m]."""
        kept = np.full(len(self.pairs), self.clearance)
        for at, d in self._looks(arm, q, kept):
            kept[at] = np.minimum(kept[at], d)
        return kept

    def is_clear(self, arm: Arm, q: Float[np.ndarray, "time dof"], kept: Float[np.ndarray, " pair"]) -> bool:
        """Whether no pair comes nearer along a motion than `kept` [m], but for what one step may change."""
        return all(np.all(d >= kept[at] - _STEP) for at, d in self._looks(arm, q, kept))

    def _looks(
        self, arm: Arm, q: Float[np.ndarray, "time dof"], kept: Float[np.ndarray, " pair"]
    ) -> Iterator[tuple[Int[np.ndarray, " some"], Float[np.ndarray, " some"]]]:
        """Pairs that could have come as near as `kept`, and their distances [m], from pose to pose."""
        data, due = mujoco.MjData(self.model), np.zeros(len(self.pairs))
        each = np.where(np.asarray(arm.chain.prismatic), 1.0, reach_of(arm))
        gone = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(q, axis=0)) @ each)])
        for pose, so_far in zip(q, gone, strict=True):
            at = np.flatnonzero(due <= so_far)
            if len(at):
                d = self.distances(data, pose, [self.pairs[i] for i in at], 10.0)
                due[at] = so_far + np.maximum(d - kept[at], _STEP)
                yield at, d


def reach_of(arm: Arm) -> float:
    """How far a point of an arm, or of what it holds, may be from an axis of its own [m]."""
    return float(np.linalg.norm(np.asarray(arm.chain.p), axis=1).sum()) + 0.3


def scene_of(
    arm: Arm, source: MjcfSource, clearance: float, floor: float | None, *, collisions: bool = True
) -> Scene:
    """Read a file once more, with its meshes, and find what could touch.

    Args:
        arm: for its ranges.
        source: its file.
        clearance: to keep [m].
        floor: height of the floor where the file has none [m]; None for no floor.
        collisions: False for an arm that nothing is in the way of.

    Raises:
        InputError: meshes are missing, so that nobody can tell.
    """
    if not collisions:
        return Scene(
            source.model,
            source,
            (),
            _owners(source.model, source),
            clearance,
            ("collisions were not checked",),
        )
    notes: list[str] = []
    assumed = ""
    with own_log():
        spec = with_shapes(source.document)
        shaped = _shapes(spec, arm, source, notes)
        if floor is not None and not any(g.type == mujoco.mjtGeom.mjGEOM_PLANE for g in spec.geoms):
            spec.worldbody.add_geom(
                name=_FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, floor]
            )
            assumed = f"a floor is assumed at z = {floor:g} m; --floor says another height, --no-floor none"
        try:
            model = spec.compile()
        except ValueError as error:
            said = reason(error)
            raise InputError(
                f"{source.path}: its geometry cannot be read ({said}); put the meshes there, or leave collisions "
                "out by --no-collisions"
            ) from None
    owner = _owners(model, source)
    whole = Scene(model, source, (), owner, clearance, ())
    pairs, more = _could_touch(whole, arm, list(_pairs(whole, shaped)))
    if assumed and pairs:
        more.append(assumed)
    if any(model.geom_type[g] == _HFIELD for g in range(model.ngeom)):
        more.append("height fields are not checked")
    return dataclasses.replace(whole, pairs=tuple(pairs), notes=(*notes, *more))


def _shapes(spec: mujoco.MjSpec, arm: Arm, source: MjcfSource, notes: list[str]) -> bool:
    """See to it that the arm has geometry; whether contype and conaffinity of geoms count."""
    every = list(spec.bodies)  # in the order of the compiled model; they need not have names
    bodies = [every[link.body_id] for link in source.links]
    own = [geom for body in bodies for geom in body.find_all("geom")] if bodies else []
    if any(geom.contype or geom.conaffinity for geom in own):
        return True
    if is_franka_panda(arm):
        for k, capsule in enumerate(published()["panda"]["capsules"]):
            body = bodies[capsule["link"] - 1] if capsule["link"] else bodies[0].parent
            body.add_geom(
                name=f"capsule {k + 1} of link {capsule['link']}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[capsule["radius"], 0, 0],
                fromto=np.ravel(capsule["ends"]),
                contype=1,
                conaffinity=1,
            )
        notes.append("the arm's geoms are for looks: Franka's published collision capsules stand for them")
        return True
    if own:
        notes.append("no geom of the arm takes part in contacts, so all of them count")
    else:
        notes.append("the arm has no geoms, so collisions cannot be checked")
    return False


def _owners(model: mujoco.MjModel, source: MjcfSource) -> Int[np.ndarray, " body"]:
    link = {one.body_id: k for k, one in enumerate(source.links)}
    owner = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        owner[body] = link.get(body, owner[model.body_parentid[body]])
    return owner


def _pairs(scene: Scene, shaped: bool) -> Iterator[Pair]:
    """Geoms of different links, or of a link and what stands still, that MuJoCo would let touch."""
    model, owner = scene.model, scene.owner
    base = int(model.body_parentid[scene.source.links[0].body_id])
    apart = {tuple(sorted(divmod(int(s), 1 << 16))) for s in model.exclude_signature}
    for a, b in itertools.combinations(range(model.ngeom), 2):
        if _HFIELD in (model.geom_type[a], model.geom_type[b]):
            continue
        body_a, body_b = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
        i, j = owner[body_a], owner[body_b]
        touching = i == j or (min(i, j) >= 0 and abs(i - j) == 1)
        if base and {body_a, body_b} & {base} and {i, j} == {-1, 0}:
            touching = True  # the first link turns on what carries it
        if touching or tuple(sorted((body_a, body_b))) in apart:
            continue
        mask = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
            model.geom_contype[b] & model.geom_conaffinity[a]
        )
        if mask or not shaped:
            yield Pair(a, b)


def _could_touch(scene: Scene, arm: Arm, pairs: list[Pair]) -> tuple[list[Pair], list[str]]:
    """Without pairs of links that are close in nearly every pose: they are built so."""
    if not pairs:
        return [], []
    close = (_sampled(scene, arm, pairs) < scene.clearance).mean(0) > _ALWAYS
    for k, pair in enumerate(pairs):
        links = [scene.owner[scene.model.geom_bodyid[g]] for g in (pair.a, pair.b)]
        close[k] &= min(links) >= 0 or max(links) == 0
    built = sorted(
        {f"{scene.name(p.a)} and {scene.name(p.b)}" for p, c in zip(pairs, close, strict=True) if c}
    )
    notes = []
    if built:
        notes.append(f"always closer than the clearance, hence not checked: {'; '.join(built)}")
    return [p for p, c in zip(pairs, close, strict=True) if not c], notes


def _sampled(scene: Scene, arm: Arm, pairs: Sequence[Pair]) -> Float[np.ndarray, "pose pair"]:
    """Distances in random poses [m]."""
    rng, data = np.random.default_rng(0), mujoco.MjData(scene.model)
    lower = np.where(np.isfinite(arm.lower), arm.lower, -np.pi)
    upper = np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    poses = rng.uniform(lower, upper, (_POSES, arm.dof))
    return np.stack([scene.distances(data, q, pairs, 1.0) for q in poses])


def probes_of(scene: Scene, arm: Arm, extra: float = 0.0) -> Probes:
    """The stand-ins of the pairs that come near; `extra` clearance [m] on top of the scene's."""
    pairs = list(scene.pairs)
    if pairs:
        near = _sampled(scene, arm, pairs).min(0) < scene.clearance + _NEAR
        pairs = [pair for pair, is_near in zip(pairs, near, strict=True) if is_near]
    boxes = _boxes(scene)
    table: list[tuple] = []
    for pair in pairs:
        ways = []
        for a, b in ((pair.a, pair.b), (pair.b, pair.a)):
            if scene.model.geom_type[a] == _PLANE:
                continue
            centres, radius, loss = _spheres(boxes[a])
            ways.append((loss, a, b, centres, radius))
        _, a, b, centres, radius = min(ways, key=lambda way: way[0])
        box = boxes[b]
        table += [
            (boxes[a].link, centre, radius, box.link, box.R, box.p, box.half, box.rounding)
            for centre in centres
        ]
    columns = list(zip(*table, strict=True)) if table else [[]] * 8
    shapes = ((), (3,), (), (), (3, 3), (3,), (3,), ())
    kinds = (int, float, float, int, float, float, float, float)
    arrays = [
        np.array(column, kind).reshape(len(table), *shape)
        for column, kind, shape in zip(columns, kinds, shapes, strict=True)
    ]
    return Probes(*map(jnp.asarray, arrays), clearance=jnp.asarray(scene.clearance + extra))


@dataclasses.dataclass(frozen=True)
class _Box:
    """A rounded box in the frame of its link, or of the world."""

    link: int
    R: Float[np.ndarray, "3 3"]
    p: Float[np.ndarray, "3"]
    half: Float[np.ndarray, "3"]
    rounding: float


def _boxes(scene: Scene) -> Mapping[int, _Box]:
    """Of every geom."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    frames = {-1: (np.eye(3), np.zeros(3))}
    for k, link in enumerate(scene.source.links):
        body = link.body_id
        R = data.xmat[body].reshape(3, 3)
        frames[k] = (R @ link.R, data.xpos[body] + R @ link.p)
    out = {}
    for g in range(model.ngeom):
        link = int(scene.owner[model.geom_bodyid[g]])
        R_l, p_l = frames[link]
        half, rounding, centre = _shape(model, g)
        R_g = data.geom_xmat[g].reshape(3, 3)
        p_g = data.geom_xpos[g] + R_g @ centre
        out[g] = _Box(link, R_l.T @ R_g, R_l.T @ (p_g - p_l), half, rounding)
    return out


def _shape(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Half sizes, rounding and centre of the rounded box of a geom, in its own frame [m]."""
    kind, size, zero = mujoco.mjtGeom(int(model.geom_type[g])), model.geom_size[g], np.zeros(3)
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        return np.array([1e3, 1e3, 1e3]), 0.0, np.array([0, 0, -1e3])
    if kind == types.mjGEOM_SPHERE:
        return zero, float(size[0]), zero
    if kind == types.mjGEOM_CAPSULE:
        return np.array([0, 0, size[1]]), float(size[0]), zero
    if kind == types.mjGEOM_CYLINDER:
        return np.array([size[0], size[0], size[1]]), 0.0, zero
    if kind == types.mjGEOM_ELLIPSOID:
        least = float(size.min())
        return size - least, least, zero
    if kind == types.mjGEOM_BOX:
        return size.copy(), 0.0, zero
    return model.geom_aabb[g, 3:].copy(), 0.0, model.geom_aabb[g, :3].copy()


def _spheres(box: _Box) -> tuple[list[np.ndarray], float, float]:
    """Centres in the frame of the link, common radius, and by how much they stick out of the box [m]."""
    k = int(np.argmax(box.half))
    thick = float(np.linalg.norm(np.delete(box.half, k))) + box.rounding
    long = float(box.half[k])
    count = int(np.clip(np.ceil(2 * long / max(thick, 1e-3)) + 1, 1, _SPHERES)) if long > 1e-6 else 1
    gap = long / max(count - 1, 1) if count > 1 else 0.0
    radius = float(np.hypot(thick, gap)) if count > 1 else thick
    steps = np.linspace(-long, long, count) if count > 1 else np.zeros(1)
    return [box.p + box.R[:, k] * s for s in steps], radius, radius - box.rounding
