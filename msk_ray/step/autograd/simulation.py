"""`Simulation`: a batch of worlds whose step is an autograd function of torch tensors."""

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.autograd.backward import Backward, ExternalForces, Needs, StepState
from msk_ray.step.autograd.contact_state import Contact
from msk_ray.step.autograd.flags import known_none
from msk_ray.step.autograd.jacobian import Linearization
from msk_ray.step.autograd.modes import make_backward
from msk_ray.step.autograd.parameter_tensors import check_values
from msk_ray.step.autograd.step_parameters import Bundles, StepParameters
from msk_ray.step.autograd.stepper import Engine, Stepper
from msk_ray.step.autograd.tangent import Tangent
from msk_ray.step.autograd.tape import TapePerSubstep
from msk_ray.step.errors import ConfigError, DeviceError, UnsupportedModelError
from msk_ray.step.forward import Kernels, WorldBatch
from msk_ray.step.forward.capacity import UNKNOWN, Capacity
from msk_ray.step.forward.contact_watch import ContactQuery
from msk_ray.step.forward.stages import PACKAGE


def resolve_device(device: str) -> torch.device:
    """The torch device of a name such as "cpu", "cuda" or "cuda:1".

    Raises:
        DeviceError: torch or Warp does not see that device.
    """
    try:
        resolved = torch.device(device)
    except RuntimeError:
        raise DeviceError(f"unknown device {device!r}: write cpu, cuda or cuda:0") from None
    if resolved.type == "cpu":
        return resolved
    if resolved.type != "cuda":
        raise DeviceError(f"device {device!r} is not supported: write cpu, cuda or cuda:0")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (resolved.index or 0) >= count:
        seen = f"{count} CUDA device(s)" if count else "no CUDA device"
        raise DeviceError(
            f"device {device!r} asked for, but torch sees {seen}: write --device cpu (in Python device='cpu'), "
            "or fix the driver"
        )
    if not wp.is_cuda_available():
        raise DeviceError("torch sees a CUDA device but Warp does not: check that driver and warp-lang fit")
    return torch.device("cuda", resolved.index or 0)


def use_device(device: str) -> None:
    """Make a device the default of torch and Warp in this process, so that it uses no other GPU.

    Raises:
        DeviceError: there is no such device.
    """
    target = resolve_device(device)
    if target.type == "cuda":
        torch.cuda.set_device(target)
        wp.set_device(str(target))


class WarpSimStep(torch.autograd.Function):
    """(ctrl, qpos, qvel, act, bundle of parameters, forces) to (qpos, qvel, act) one env step later, differentiable in
    all.
    """

    @staticmethod
    def forward(
        ctx: Any, sim: "Simulation", parameters: StepParameters, ctrl: Tensor, *inputs: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        start, forces = StepState(*inputs[:3]), inputs[4:]
        end, saved = sim.step_and_save(ctrl, start, ExternalForces(*forces) if forces else None, parameters)
        # This step's engine, because the simulation may continue with another one.
        ctx.engine = sim.engine
        ctx.names, ctx.wanted = tuple(parameters.values), parameters.wanted
        ctx.bundle = parameters.bundle  # kept alive for further steps with the same values
        ctx.save_for_backward(*parameters.values.values(), *saved)
        return end

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, qpos: Tensor, qvel: Tensor, act: Tensor) -> tuple[Tensor | None, ...]:
        count = len(ctx.names)
        values, saved = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        on_state, on_bundle, on_forces = (ctx.needs_input_grad[k:m] for k, m in ((2, 6), (6, 7), (7, None)))
        wanted = ctx.wanted if any(on_bundle) else ()
        cotangent = StepState(qpos, qvel, act)
        ctx.engine.batch.check_model()
        ctx.engine.settle()
        ctx.engine.set_parameters(dict(zip(ctx.names, values, strict=True)))
        gradients = ctx.engine.backward.vjp(saved, cotangent, Needs(*on_state, *on_forces)._replace(parameters=wanted))
        # A zero cotangent has a zero gradient, even if a world's Jacobian is not finite: 0 × NaN must not leak out.
        unused = torch.cat(cotangent, dim=-1).eq(0).all(-1)
        all_used = known_none(unused)

        def masked(g: Tensor | None) -> Tensor | None:
            if all_used or g is None or not g.numel():
                return g
            return g.masked_fill(unused.view(-1, *[1] * (g.dim() - 1)), 0.0)

        states = (masked(g) for g in (gradients.ctrl, gradients.qpos, gradients.qvel, gradients.act))
        forces = (masked(g) for g in (gradients.qfrc_applied, gradients.xfrc_applied)[: len(on_forces)])
        return (None, None, *states, gradients.parameters, *forces)


class Simulation:
    """`nworld` worlds of one model, stepped by `substeps` calls of `mujoco_warp.step` under each control.

    Args:
        model: the compiled MuJoCo model; its timestep is the substep's.
        nworld: number of worlds W.
        substeps: physics steps per call of `step`.
        backward: how to differentiate: a mode or its name (tape_per_substep, tape_all, fd_jacobian, hybrid); None for
            forward only.
        device: "cpu", "cuda" or "cuda:N".
        capacity: contacts and constraint rows per world. Where it is 0, a bound from the geometry if that is small,
            otherwise 1.5 times what a short probe in C MuJoCo needed, which grows when a step needs more.
        tolerance: solver tolerance, which may be below mujoco_warp's floor of 1e-6.
        kernels: `Kernels(ordered=True)` sums in a fixed order, so that a GPU repeats steps and gradients bit for bit;
            `Kernels(fused_solver=True)` solves constraints in one launch; `Kernels(iterations=1, ls_iterations=5)`
            stops the solver early. By default its limits are the model's, but at least 100 and 50 iterations, because
            gradients need a converged solver.

    Do not edit the model while the simulation exists: the next step or backward pass would raise an error.

    Raises:
        UnsupportedModelError: the model cannot be stepped, or not differentiated by `backward`.
        DeviceError: no such device.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        substeps: int,
        backward: Backward | str | None = TapePerSubstep.name,
        device: str | torch.device = "cpu",
        *,
        capacity: Capacity = UNKNOWN,
        tolerance: float | None = None,
        kernels: Kernels = PACKAGE,
    ) -> None:
        if nworld < 1 or substeps < 1:
            raise ConfigError(f"nworld and substeps must be at least 1, not {nworld} and {substeps}")
        if not isinstance(model, mujoco.MjModel):
            raise ConfigError(
                f"model must be a mujoco.MjModel, not {type(model).__name__}: write mujoco.MjModel.from_xml_path(...)"
            )
        self.device = resolve_device(str(device))
        self.model = model
        self.nworld = nworld
        self.substeps = substeps
        self.tangent = Tangent(model, self.device)
        self._bundles = Bundles(model, nworld)
        self._widths = (("ctrl", model.nu), ("qpos", model.nq), ("qvel", model.nv), ("act", model.na))
        self._tensor_device = torch.empty(0, device=self.device).device
        mode = make_backward(backward) if isinstance(backward, str) else backward
        batch = WorldBatch(
            model,
            nworld,
            substeps,
            str(self.device),
            capacity=capacity,
            tolerance=tolerance,
            kernels=kernels,
        )
        self._stepper = Stepper(batch, mode)

    @property
    def engine(self) -> Engine:
        """The engine that computed the last step."""
        return self._stepper.engine

    @property
    def batch(self) -> WorldBatch:
        """The worlds. A step or `diagnostics` that enlarges buffers replaces it, so do not keep a reference."""
        return self.engine.batch

    @property
    def backward(self) -> Backward | None:
        """The backward mode, attached to `batch`."""
        return self.engine.backward

    @property
    def timestep(self) -> float:
        """Duration of one call of `step` [s]."""
        return float(self.model.opt.timestep) * self.substeps

    def require_backward(self) -> Backward:
        """The backward mode; raises if the simulation is forward only."""
        if self.backward is None:
            raise ConfigError("this Simulation was made without a backward mode; wrap the call in torch.no_grad()")
        return self.backward

    def initial_state(self) -> StepState:
        """The model's reference configuration at rest, in every world."""
        zeros = lambda n: torch.zeros((self.nworld, n), device=self.device)  # noqa: E731
        qpos0 = torch.as_tensor(self.model.qpos0, dtype=torch.float32, device=self.device)
        return StepState(qpos0.expand(self.nworld, -1).clone(), zeros(self.model.nv), zeros(self.model.na))

    def step(
        self,
        ctrl: Tensor,
        qpos: Tensor,
        qvel: Tensor,
        act: Tensor,
        *,
        qfrc_applied: Tensor | None = None,
        xfrc_applied: Tensor | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> StepState:
        """Step all worlds by one env step; a pure, differentiable function of its arguments.

        Args:
            ctrl: shape (W, nu). qpos: (W, nq). qvel: (W, nv). act: (W, na). float32 on `device`.
            qfrc_applied: forces on the degrees of freedom [N, N m], (W, nv), held over the substeps; None for none.
            xfrc_applied: force [N] and torque [N m] on each body at its centre of mass, in world coordinates,
                (W, nbody, 6), held likewise.
            parameters: values of model fields for this step, by their name in MjModel (body_mass, opt.gravity), each in
                the field's shape for all worlds, or with a row per world in front. Other fields keep the model's
                values, also those that MuJoCo's compiler has derived (docs/step/parameters.md). The first step with a
                new name records the graph again.

        Returns:
            New tensors (qpos, qvel, act).

        Raises:
            ConfigError: an argument has another shape, dtype or device.
            SimulationError: a step lost contacts or constraint rows, and larger buffers were not allowed or would not
                help. On CUDA it may be an earlier step, whose results are NaN in the affected worlds.
            ConfigError: the MjModel was edited after the simulation was created.
            UnsupportedModelError: a gradient is needed, and the backward mode does not cover applied forces or
                parameters; or the model uses something with which a parameter cannot be varied.
        """
        applied, values = self._checked((ctrl, qpos, qvel, act), qfrc_applied, xfrc_applied, parameters)
        given = self._bundles.of(values)
        inputs = (ctrl, qpos, qvel, act, given.bundle, *(applied or ()))
        if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs):
            return StepState(*WarpSimStep.apply(self, given, *inputs))
        return self._stepper.step(ctrl, StepState(qpos, qvel, act), applied, given.values)

    @torch.no_grad()
    def linearize(
        self,
        ctrl: Tensor,
        qpos: Tensor,
        qvel: Tensor,
        act: Tensor,
        *,
        qfrc_applied: Tensor | None = None,
        xfrc_applied: Tensor | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> Linearization:
        """Jacobians of one env step of every world, in tangent space: x' = end + A δx + B δu to first order.

        Computed by the backward mode: exactly with the tapes, with one more world per row and without another forward
        pass; from perturbed copies with fd_jacobian. Gradients are not clipped here.

        Args:
            ctrl, qpos, qvel, act, qfrc_applied, xfrc_applied, parameters: as for `step`.

        Returns:
            A (W, 2 nv + na, 2 nv + na), B (W, 2 nv + na, nu) and the state after the step. Entries are ordered as in
            MuJoCo's mjd_transitionFD: positions in tangent space, velocities, activations.

        Raises:
            ConfigError: as for `step`, or the simulation has no backward mode.
            SimulationError, UnsupportedModelError: as for `step`.
        """
        self.require_backward()
        applied, values = self._checked((ctrl, qpos, qvel, act), qfrc_applied, xfrc_applied, parameters)
        start = StepState(qpos, qvel, act)
        end, saved = self.step_and_save(ctrl, start, applied, self._bundles.of(values))
        self.engine.settle()
        return Linearization(*self.require_backward().jacobian(saved, start, end, self.tangent), end)

    def open_parameters(self, names: Iterable[str]) -> None:
        """Prepare `step` for these parameters. `step` does this itself; call it to record the graph in advance.

        Raises:
            ConfigError: unknown parameter, or the model has no such elements.
            UnsupportedModelError: the model uses something with which the parameter cannot be varied.
        """
        self._stepper.open_parameters(names)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that `step` is prepared for."""
        return self.batch.parameters

    def settle(self) -> None:
        """Wait until all steps so far have finished.

        Raises:
            SimulationError: one of them lost contacts or constraint rows.
        """
        self.engine.settle()

    def contact_forces(self) -> Tensor:
        """Force of all contacts on every geom in world coordinates [N], shape (W, G, 3).

        Values only, without a gradient, from the last substep of the last `step`: read them before the next step, and
        before a backward pass, which uses the same buffers.
        """
        return self.engine.contact_forces()

    def measure_sensors(self) -> None:
        """Take readings of the model's sensors in every step from now on, for `sensordata`."""
        self.batch.measures_sensors = True

    def sensordata(self) -> Tensor:
        """MuJoCo's `sensordata` of the last step, (W, nsensordata): values only, of forces and accelerations in its
        last substep. For sensors that are functions of the state, `Sensors` has those of the state itself, with
        gradients.

        Raises:
            ConfigError: the last step took no readings.
        """
        return self.engine.sensordata()

    def measure_contacts(self, query: ContactQuery) -> None:
        """Watch these contacts in every step from now on, for `contacts`."""
        self.batch.contacts.add(query)

    def contacts(self, query: ContactQuery) -> Contact:
        """Contacts in the substeps of the last step: values only; read them before the next step.

        Raises:
            ConfigError: the last step did not watch these.
        """
        return Contact.of(self.engine.contacts(query))

    def _check_inputs(self, *inputs: Tensor) -> None:
        # Copying into the batch's buffers would broadcast one world to all, and convert dtypes and devices silently.
        for (name, width), value in zip(self._widths, inputs, strict=True):
            self._check_input(name, value, width)

    def _checked(
        self,
        inputs: tuple[Tensor, ...],
        qfrc: Tensor | None,
        xfrc: Tensor | None,
        parameters: Mapping[str, Tensor] | None,
    ) -> tuple[ExternalForces | None, dict[str, Tensor]]:
        """Check a step's arguments and open its parameters; returns applied forces and parameters."""
        self._check_inputs(*inputs)
        values = dict(parameters or {})
        self.open_parameters(values)
        check_values(self.model, self.nworld, values, self._tensor_device)
        return self._applied(qfrc, xfrc), values

    def _check_input(self, name: str, value: Tensor, *shape: int) -> None:
        if value.shape != (self.nworld, *shape):
            raise ConfigError(
                f"step: {name} has shape {tuple(value.shape)}, but {self.nworld} worlds of this model take "
                f"{(self.nworld, *shape)}"
            )
        if value.dtype != torch.float32:
            raise ConfigError(f"step: {name} is {value.dtype}: write {name}.float()")
        if value.device != self._tensor_device:
            raise ConfigError(
                f"step: {name} is on {value.device}, the simulation on {self._tensor_device}: write "
                f"{name}.to({str(self._tensor_device)!r})"
            )

    def _applied(self, qfrc: Tensor | None, xfrc: Tensor | None) -> ExternalForces | None:
        """Both kinds of applied forces, checked; None if there are none."""
        if qfrc is None and xfrc is None:
            return None
        nv, nbody = self.model.nv, self.model.nbody
        applied = ExternalForces(
            torch.zeros((self.nworld, nv), device=self._tensor_device) if qfrc is None else qfrc,
            torch.zeros((self.nworld, nbody, 6), device=self._tensor_device) if xfrc is None else xfrc,
        )
        self._check_input("qfrc_applied", applied.qfrc, nv)
        self._check_input("xfrc_applied", applied.xfrc, nbody, 6)
        return applied

    def step_and_save(
        self, ctrl: Tensor, start: StepState, applied: ExternalForces | None, parameters: StepParameters
    ) -> tuple[StepState, tuple[Tensor, ...]]:
        """One env step outside autograd, and the tensors that the backward mode needs to differentiate it.

        Raises:
            ConfigError: the simulation has no backward mode.
            UnsupportedModelError: the mode does not cover applied forces, or gradients of parameters.
        """
        mode = self.require_backward()
        if parameters.wanted and not mode.covers_parameters:
            raise UnsupportedModelError(
                f"backward mode {mode.name} has no gradients of parameters ({', '.join(parameters.wanted)}): write "
                f"backward={TapePerSubstep.name!r}"
            )
        if applied is None:
            end = self._stepper.step(ctrl, start, None, parameters.values)
            # Ask again: the step may have replaced the mode by one with larger buffers.
            return end, self.require_backward().save(ctrl, start, end)
        if not mode.covers_applied:
            raise UnsupportedModelError(
                f"backward mode {mode.name} does not differentiate steps with applied forces: write "
                "backward='tape_per_substep', or leave qfrc_applied and xfrc_applied out"
            )
        end = self._stepper.step(ctrl, start, applied, parameters.values)
        return end, self.require_backward().save(ctrl, start, end, applied)

    @property
    def capacity(self) -> Capacity:
        """Current room for contacts and constraint rows per world."""
        return self.batch.capacity

    def reserve(self, capacity: Capacity) -> None:
        """Enlarge the buffers to at least `capacity` per world, unless the constructor fixed them."""
        self._stepper.reserve(capacity)

    def diagnostics(self) -> dict[str, float]:
        """Diagnostics since the last call: share of worlds at a solver limit, largest used shares of the contact and
        row buffers, and the backward mode's diagnostics. Enlarges buffers that are nearly full.

        Raises:
            SimulationError: contacts or constraint rows were lost to a full buffer.
        """
        return self._stepper.diagnostics()
