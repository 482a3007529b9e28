"""Readings of a model's sensors as functions of (qpos, qvel), with gradients.

A sensor is compiled into its law, a function of a state's `Readings`, when it is first asked for. Sensors of forces and
accelerations have no law: MuJoCo computes them within a step, and `Simulation.sensordata` has their values.

Axes: W worlds, D entries of a sensor.
"""

from collections.abc import Callable
from functools import cache
from typing import Final

import mujoco
import torch
from torch import Tensor

from msk_ray.step.autograd.kinematics import Frames, Kinematics
from msk_ray.step.autograd.tangent import quat_conjugate, quat_log, quat_multiply, quat_rotate
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.errors import ConfigError, UnsupportedModelError

_S, _OBJ, _TRN, _JNT = mujoco.mjtSensor, mujoco.mjtObj, mujoco.mjtTrn, mujoco.mjtJoint

Law = Callable[["Readings"], Tensor]
"""From a state to a sensor's reading before its cutoff, (W, D)."""

OF_A_STEP: Final = frozenset(
    (
        *(_S.mjSENS_TOUCH, _S.mjSENS_CONTACT, _S.mjSENS_FORCE, _S.mjSENS_TORQUE, _S.mjSENS_ACCELEROMETER),
        *(_S.mjSENS_FRAMELINACC, _S.mjSENS_FRAMEANGACC, _S.mjSENS_JOINTLIMITFRC, _S.mjSENS_TENDONLIMITFRC),
        *(_S.mjSENS_ACTUATORFRC, _S.mjSENS_JOINTACTFRC, _S.mjSENS_TENDONACTFRC),
    )
)
"""Sensors of forces and accelerations: their readings belong to a step, and have no gradient."""


class Sensors:
    """The sensors of a model that are functions of (qpos, qvel).

    Args:
        kinematics: frames of the model's bodies.
        tendons: gives lengths and rates of its tendons; called once, if a sensor needs them.
    """

    def __init__(self, kinematics: Kinematics, tendons: Callable[[], Tendons]) -> None:
        self.kinematics = kinematics
        self.model = kinematics.model
        self._tendons = cache(tendons)
        self._laws: dict[int, Law] = {}

    def __call__(self, qpos: Tensor, qvel: Tensor) -> "Readings":
        """Readings in the states qpos (W, nq) and qvel (W, nv)."""
        return Readings(
            self, qpos, qvel, lambda: self.kinematics(qpos, qvel), lambda: self._tendons()(qpos, qvel), self._no_step
        )

    def id(self, name: str) -> int:
        """Id of a sensor.

        Raises:
            ConfigError: the model has no such sensor.
        """
        try:
            return int(self.model.sensor(name).id)
        except KeyError:
            named = [self.model.sensor(i).name for i in range(self.model.nsensor)]
            raise ConfigError(
                f"the model has no sensor {name!r}: it has {', '.join(filter(None, named)) or 'none with a name'}"
            ) from None

    def of_a_step(self, sensor: int) -> bool:
        """Whether a sensor's readings belong to a step."""
        return _S(self.model.sensor_type[sensor]) in OF_A_STEP

    def law(self, sensor: int) -> Law:
        """The law of a sensor that is a function of the state, with its cutoff.

        Raises:
            UnsupportedModelError: there is none.
        """
        if sensor not in self._laws:
            kind = _S(self.model.sensor_type[sensor])
            if kind not in _LAWS:
                raise UnsupportedModelError(
                    f"sensor {self.model.sensor(sensor).name!r} cannot be read: {_name(kind)} is not among "
                    f"{', '.join(sorted(map(_name, {*_LAWS, *OF_A_STEP})))}"
                )
            self._laws[sensor] = self._cut(_LAWS[kind](self, sensor), sensor)
        return self._laws[sensor]

    def _cut(self, law: Law, sensor: int) -> Law:
        """The law with its readings limited to the sensor's cutoff."""
        cutoff = float(self.model.sensor_cutoff[sensor])
        return law if cutoff <= 0.0 else lambda readings: law(readings).clamp(-cutoff, cutoff)

    def _no_step(self) -> Tensor:
        raise ConfigError("sensors of forces and accelerations belong to a step: read Simulation.sensordata after it")


class Readings:
    """The sensors in one state, by name, each (W, D); computed when they are asked for, and once.

    Args:
        sensors: the model's.
        qpos, qvel: the state, (W, nq) and (W, nv).
        frames, tendons: give what sensors need of the state.
        sensordata: gives the readings that belong to the step which led to the state, (W, nsensordata).
    """

    def __init__(
        self,
        sensors: Sensors,
        qpos: Tensor,
        qvel: Tensor,
        frames: Callable[[], Frames],
        tendons: Callable[[], tuple[Tensor, Tensor]],
        sensordata: Callable[[], Tensor],
    ) -> None:
        self._sensors = sensors
        self.qpos, self.qvel = qpos, qvel
        self._frames, self._tendons, self._sensordata = cache(frames), cache(tendons), cache(sensordata)
        self._values: dict[str, Tensor] = {}

    def __getitem__(self, name: str) -> Tensor:
        """Reading of a sensor, in its units.

        Raises:
            ConfigError: no such sensor, or no step has led to the state.
            UnsupportedModelError: the sensor cannot be read.
        """
        if name not in self._values:
            sensor = self._sensors.id(name)
            if self._sensors.of_a_step(sensor):
                first, size = self._sensors.model.sensor_adr[sensor], self._sensors.model.sensor_dim[sensor]
                self._values[name] = self._sensordata()[:, first : first + size]
            else:
                self._values[name] = self._sensors.law(sensor)(self)
        return self._values[name]

    @property
    def frames(self) -> Frames:
        """Frames of the state."""
        return self._frames()

    @property
    def tendons(self) -> tuple[Tensor, Tensor]:
        """Lengths [m] and rates [m/s] of tendons, each (W, ntendon)."""
        return self._tendons()


class _Mount:
    """A frame fixed in a body, to which a sensor is attached or refers."""

    def __init__(self, sensors: Sensors, kind: int, ident: int) -> None:
        m = sensors.model
        match kind:
            case _OBJ.mjOBJ_XBODY:
                body, pos, quat = ident, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
            case _OBJ.mjOBJ_BODY:
                body, pos, quat = ident, m.body_ipos[ident], m.body_iquat[ident]
            case _OBJ.mjOBJ_GEOM:
                body, pos, quat = m.geom_bodyid[ident], m.geom_pos[ident], m.geom_quat[ident]
            case _OBJ.mjOBJ_SITE:
                body, pos, quat = m.site_bodyid[ident], m.site_pos[ident], m.site_quat[ident]
            case _:
                raise UnsupportedModelError(
                    f"a sensor on {mujoco.mjtObj(kind).name.removeprefix('mjOBJ_').lower()} "
                    f"{ident} cannot be read: put it on a site, geom or body"
                )
        self._body = int(body)
        self._bodies = sensors.kinematics.indices("body", (self._body,))
        self._offset = sensors.kinematics.tensor([pos])
        self._quat = None if tuple(quat) == (1.0, 0.0, 0.0, 0.0) else sensors.kinematics.tensor(quat)

    def point(self, frames: Frames) -> tuple[Tensor, Tensor]:
        """Its origin [m] and the velocity of that [m/s], each (W, 3)."""
        position, velocity = frames.fixed_points(self._bodies, self._offset)
        return position.squeeze(1), velocity.squeeze(1)

    def orientation(self, frames: Frames) -> Tensor:
        """Its orientation, unit quaternions (w, x, y, z), (W, 4)."""
        own = frames.orientation(self._body)
        return own if self._quat is None else quat_multiply(own, self._quat.expand_as(own))

    def angular_velocity(self, frames: Frames) -> Tensor:
        """Its angular velocity in world coordinates [rad/s], (W, 3)."""
        return frames.angular_velocity(self._body)

    def inward(self, frames: Frames, vector: Tensor) -> Tensor:
        """A vector (W, 3) of world coordinates in its own."""
        return quat_rotate(quat_conjugate(self.orientation(frames)), vector)


def _name(kind: mujoco.mjtSensor) -> str:
    """The element in MJCF, such as gyro."""
    return str(kind.name.removeprefix("mjSENS_").lower().replace("_", "-"))


def _mount(sensors: Sensors, sensor: int) -> _Mount:
    m = sensors.model
    return _Mount(sensors, m.sensor_objtype[sensor], m.sensor_objid[sensor])


def _reference(sensors: Sensors, sensor: int) -> _Mount | None:
    """The frame that a sensor's readings refer to; None: the world."""
    m = sensors.model
    none = m.sensor_refid[sensor] < 0
    return None if none else _Mount(sensors, m.sensor_reftype[sensor], m.sensor_refid[sensor])


def _gyro(sensors: Sensors, sensor: int) -> Law:
    at = _mount(sensors, sensor)
    return lambda r: at.inward(r.frames, at.angular_velocity(r.frames))


def _velocimeter(sensors: Sensors, sensor: int) -> Law:
    at = _mount(sensors, sensor)
    return lambda r: at.inward(r.frames, at.point(r.frames)[1])


def _magnetometer(sensors: Sensors, sensor: int) -> Law:
    at, field = _mount(sensors, sensor), sensors.kinematics.tensor([sensors.model.opt.magnetic])
    return lambda r: at.inward(r.frames, field.expand(len(r.qpos), 3))


def _frame_position(sensors: Sensors, sensor: int) -> Law:
    at, reference = _mount(sensors, sensor), _reference(sensors, sensor)
    if reference is None:
        return lambda r: at.point(r.frames)[0]
    return lambda r: reference.inward(r.frames, at.point(r.frames)[0] - reference.point(r.frames)[0])


def _frame_orientation(sensors: Sensors, sensor: int) -> Law:
    at, reference = _mount(sensors, sensor), _reference(sensors, sensor)
    if reference is None:
        return lambda r: at.orientation(r.frames)
    return lambda r: quat_multiply(quat_conjugate(reference.orientation(r.frames)), at.orientation(r.frames))


def _frame_axis(sensors: Sensors, sensor: int) -> Law:
    orientation = _frame_orientation(sensors, sensor)
    axis = sensors.model.sensor_type[sensor] - int(_S.mjSENS_FRAMEXAXIS)
    unit = sensors.kinematics.tensor([[float(i == axis) for i in range(3)]])
    return lambda r: quat_rotate(orientation(r), unit.expand(len(r.qpos), 3))


def _frame_velocity(sensors: Sensors, sensor: int) -> Law:
    at, reference = _mount(sensors, sensor), _reference(sensors, sensor)
    if reference is None:
        return lambda r: at.point(r.frames)[1]

    def law(r: Readings) -> Tensor:
        (position, velocity), (origin, own) = at.point(r.frames), reference.point(r.frames)
        carried = own + torch.linalg.cross(reference.angular_velocity(r.frames), position - origin)
        return reference.inward(r.frames, velocity - carried)

    return law


def _frame_angular_velocity(sensors: Sensors, sensor: int) -> Law:
    at, reference = _mount(sensors, sensor), _reference(sensors, sensor)
    if reference is None:
        return lambda r: at.angular_velocity(r.frames)
    return lambda r: reference.inward(r.frames, at.angular_velocity(r.frames) - reference.angular_velocity(r.frames))


def _of_subtree(measure: Callable[[Frames, int], Tensor]) -> Callable[[Sensors, int], Law]:
    def law(sensors: Sensors, sensor: int) -> Law:
        body = int(sensors.model.sensor_objid[sensor])
        if not sensors.model.body_subtreemass[body]:
            raise UnsupportedModelError(
                f"sensor {sensors.model.sensor(sensor).name!r} cannot be read: its subtree has no mass"
            )
        return lambda r: measure(r.frames, body)

    return law


def _of_joint(part: int, width: int = 1) -> Callable[[Sensors, int], Law]:
    """Entries of a joint in qpos (0) or qvel (1)."""

    def law(sensors: Sensors, sensor: int) -> Law:
        m = sensors.model
        first = int((m.jnt_qposadr, m.jnt_dofadr)[part][m.sensor_objid[sensor]])
        return lambda r: (r.qpos, r.qvel)[part][:, first : first + width]

    return law


def _turn_of(sensors: Sensors, joint: int) -> Law:
    """The unit quaternion of a ball joint."""
    first = int(sensors.model.jnt_qposadr[joint])
    return lambda r: torch.nn.functional.normalize(r.qpos[:, first : first + 4], dim=-1)


def _ball_orientation(sensors: Sensors, sensor: int) -> Law:
    return _turn_of(sensors, int(sensors.model.sensor_objid[sensor]))


def _of_tendon(part: int) -> Callable[[Sensors, int], Law]:
    """Length (0) or rate (1)."""

    def law(sensors: Sensors, sensor: int) -> Law:
        tendon = int(sensors.model.sensor_objid[sensor])
        return lambda r: r.tendons[part][:, tendon : tendon + 1]

    return law


def _of_actuator(part: int) -> Callable[[Sensors, int], Law]:
    """Length (0) or rate (1) of what an actuator acts on, times its gear."""

    def law(sensors: Sensors, sensor: int) -> Law:
        m, actuator = sensors.model, int(sensors.model.sensor_objid[sensor])
        kind, (target, _) = _TRN(m.actuator_trntype[actuator]), m.actuator_trnid[actuator]
        gear = sensors.kinematics.tensor([m.actuator_gear[actuator]])
        if kind == _TRN.mjTRN_TENDON:
            return lambda r: gear[:, :1] * r.tendons[part][:, target : target + 1]
        joint = _JNT(m.jnt_type[target]) if kind in (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT) else None
        if joint in (_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE):
            first = int((m.jnt_qposadr, m.jnt_dofadr)[part][target])
            return lambda r: gear[:, :1] * (r.qpos, r.qvel)[part][:, first : first + 1]
        if joint == _JNT.mjJNT_BALL and kind == _TRN.mjTRN_JOINT:
            first, turn = int(m.jnt_dofadr[target]), _turn_of(sensors, target)
            moved: Law = lambda r: quat_log(turn(r)) if part == 0 else r.qvel[:, first : first + 3]  # noqa: E731
            return lambda r: (gear[:, :3] * moved(r)).sum(-1, keepdim=True)
        raise UnsupportedModelError(
            f"sensor {m.sensor(sensor).name!r} cannot be read: actuator {m.actuator(actuator).name!r} acts on none of "
            "hinge, slide, ball joint in its own frame, and tendon"
        )

    return law


_LAWS: Final[dict[mujoco.mjtSensor, Callable[[Sensors, int], Law]]] = {
    _S.mjSENS_GYRO: _gyro,
    _S.mjSENS_VELOCIMETER: _velocimeter,
    _S.mjSENS_MAGNETOMETER: _magnetometer,
    _S.mjSENS_FRAMEPOS: _frame_position,
    _S.mjSENS_FRAMEQUAT: _frame_orientation,
    _S.mjSENS_FRAMEXAXIS: _frame_axis,
    _S.mjSENS_FRAMEYAXIS: _frame_axis,
    _S.mjSENS_FRAMEZAXIS: _frame_axis,
    _S.mjSENS_FRAMELINVEL: _frame_velocity,
    _S.mjSENS_FRAMEANGVEL: _frame_angular_velocity,
    _S.mjSENS_SUBTREECOM: _of_subtree(Frames.center_of_mass),
    _S.mjSENS_SUBTREELINVEL: _of_subtree(Frames.com_velocity),
    _S.mjSENS_SUBTREEANGMOM: _of_subtree(Frames.angular_momentum),
    _S.mjSENS_JOINTPOS: _of_joint(0),
    _S.mjSENS_JOINTVEL: _of_joint(1),
    _S.mjSENS_BALLQUAT: _ball_orientation,
    _S.mjSENS_BALLANGVEL: _of_joint(1, width=3),
    _S.mjSENS_TENDONPOS: _of_tendon(0),
    _S.mjSENS_TENDONVEL: _of_tendon(1),
    _S.mjSENS_ACTUATORPOS: _of_actuator(0),
    _S.mjSENS_ACTUATORVEL: _of_actuator(1),
}
"""The sensors with a law, and what compiles it."""
