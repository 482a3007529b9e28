"""Changes of a model under a simulation's feet, which forward and backward would follow differently, are refused."""

import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from scenes import ant

from msk_ray.errors import ConfigError
from msk_ray.step import Simulation, TapePerSubstep
from msk_ray.step.adjoint.taped_step import TapedStep, WarpState
from msk_ray.step.forward import WorldBatch
from msk_ray.step.forward.model_watch import ModelWatch


def stepped(model: mujoco.MjModel) -> tuple[Simulation, torch.Tensor]:
    """A simulation after one step, and a loss of it."""
    sim = Simulation(model, 2, 2, TapePerSubstep(), "cpu")
    return sim, sim.step(torch.zeros(2, model.nu, requires_grad=True), *sim.initial_state()).qvel.sum()


EDITS = {
    "geom_friction": lambda m: m.geom_friction.fill(0.1),
    "dof_damping": lambda m: m.dof_damping.__setitem__(3, 0.5),
    "opt.timestep": lambda m: setattr(m.opt, "timestep", 1e-3),
    "opt.gravity": lambda m: m.opt.gravity.__setitem__(2, -1.0),
    "opt.disableflags": lambda m: setattr(m.opt, "disableflags", int(mujoco.mjtDisableBit.mjDSBL_SPRING)),
    "qpos0": lambda m: m.qpos0.__setitem__(2, 2.0),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_mjmodel_stops_the_next_step_and_backward(name):
    model = ant()
    sim, loss = stepped(model)
    EDITS[name](model)
    with pytest.raises(ConfigError, match=rf"edited after .*\({name}\)"):
        sim.step(torch.zeros(2, model.nu), *sim.initial_state())
    with pytest.raises(ConfigError, match=name):
        loss.backward()
    with pytest.raises(ConfigError, match=name):
        sim.diagnostics()


def test_an_edit_taken_back_and_an_edited_copy_are_none():
    model = ant()
    sim, loss = stepped(model)
    copy.copy(model).geom_friction[:] = 0.1
    kept = model.geom_friction.copy()
    model.geom_friction[:] = 0.1
    model.geom_friction[:] = kept
    loss.backward()
    sim.diagnostics()


def test_memory_of_others_between_the_arrays_may_change():
    """The heap may put the model's options right behind its buffer, with something small of somebody else between."""
    heap = bytearray(128)
    option = SimpleNamespace(gravity=np.frombuffer(heap, np.uint8, 8, 40), timestep=0.01, iterations=3)
    model = SimpleNamespace(qpos0=np.frombuffer(heap, np.uint8, 8, 0), opt=option)
    watch = ModelWatch(model)
    heap[20] = 7
    watch.check()
    heap[44] = 7
    with pytest.raises(ConfigError, match=r"\(opt\.gravity\)"):
        watch.check()


def test_only_memory_of_the_model_is_compared():
    """MuJoCo makes some arrays when they are asked for, wherever there is room."""
    assert not [name for name, (value, _) in ModelWatch(ant())._arrays.items() if value.flags.owndata]


def test_large_arrays_are_compared_in_diagnostics():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><hfield name="h" nrow="200" ncol="200" size="1 1 .1 .1"/></asset><worldbody>
        <geom type="hfield" hfield="h"/><body pos="0 0 .2"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    sim = Simulation(model, 1, 1, None, "cpu")
    sim.diagnostics()
    model.hfield_data[7] = 1.0
    with pytest.raises(ConfigError, match="hfield_data"):
        sim.diagnostics()


def test_arrays_of_the_warp_model_cannot_be_replaced():
    sim, _ = stepped(ant())
    model = sim.batch.model
    each = wp.array(np.tile(model.geom_friction.numpy(), (2, 1, 1)), dtype=wp.vec3, device="cpu")
    with pytest.raises(ConfigError, match=r"batch\.model\.geom_friction cannot be replaced"):
        model.geom_friction = each
    with pytest.raises(ConfigError, match=r"batch\.model\.opt\.timestep"):
        model.opt.timestep = wp.array([1e-3], dtype=float, device="cpu")
    with pytest.raises(ConfigError, match=r"batch\.model\.opt\.iterations"):
        model.opt.iterations = 3
    with pytest.raises(ConfigError, match="geom_friction"):
        del model.geom_friction
    for holder, name in ((sim.batch, "model"), (sim, "batch"), (sim, "backward")):
        with pytest.raises(AttributeError, match="no setter"):
            setattr(holder, name, None)


def test_taped_step_refuses_too():
    model = ant()
    step = TapedStep(WorldBatch(model, 1, 1, "cpu"))
    model.dof_armature[:] = 1.0
    state = WarpState(*(wp.zeros((1, n), dtype=float, device="cpu") for n in (model.nq, model.nv, model.na)))
    with pytest.raises(ConfigError, match="dof_armature"):
        step(wp.zeros((1, model.nu), dtype=float, device="cpu"), state)
