"""The differentiable step as a library of its own."""

import json
import subprocess
import sys
from pathlib import Path

_ALONE = """
import json, sys

class Refused:
    '''Nothing but the step's own dependencies is installed.'''
    allowed = {"mujoco", "mujoco_warp", "warp", "numpy", "torch", "msk_ray"}
    runner = %s
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.runner:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refused())
import msk_ray.step
assert "torch" not in sys.modules and "warp" not in sys.modules
import mujoco, torch
from msk_ray.step import Simulation, check_gradients

model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .3"><joint name="j" axis="0 1 0"/>'
    '<geom type="capsule" fromto="0 0 0 .3 0 -.1" size=".05"/></body></worldbody>'
    '<actuator><motor joint="j"/></actuator></mujoco>'
)
sim = Simulation(model, nworld=2, substeps=2)
qpos, qvel, act = sim.initial_state()
ctrl = torch.ones(2, 1, requires_grad=True)
for _ in range(3):
    qpos, qvel, act = sim.step(ctrl, qpos, qvel, act)
qpos.sum().backward()
print(json.dumps({
    "gradient": ctrl.grad.tolist(),
    "error": check_gradients(sim).max_rel_error,
    "loaded": sorted(n for n in sys.modules if n.startswith("msk_ray.") and not n.startswith("msk_ray.step")),
}))
"""

_RUNNER = (
    *("ray", "pydantic", "yaml", "tensorboard", "matplotlib", "PIL", "av", "jinja2", "aiohttp", "rich", "orjson"),
    "optuna",
)


def test_step_runs_with_its_own_dependencies_alone(root: Path) -> None:
    """A step, its gradient and its check load nothing else of the package, and none of the runner's packages."""
    done = subprocess.run(
        [sys.executable, "-c", _ALONE % repr(set(_RUNNER))], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert all(gradient != [0.0] for gradient in result["gradient"])
    assert result["error"] < 1e-3
    assert result["loaded"] == []
