"""The command: exit codes, JSON, one-line errors."""

import json
import subprocess
import sys

import mujoco
import pytest
from scenes import ant

from msk_ray.cli import run
from msk_ray.gradcheck import main
from msk_ray.step import TapePerSubstep
from msk_ray.step.autograd.modes import BACKWARD_MODES
from msk_ray.step.autograd.stepper import Stepper

pytestmark = pytest.mark.long

FAST = ["--worlds", "2", "--states", "random"]
UNSUPPORTED = """
<mujoco><option noslip_iterations="2"/><worldbody>
  <body><joint/><geom size=".1"/></body>
</worldbody></mujoco>"""


class NanSlope(TapePerSubstep):
    """The gradient by the second velocity is NaN where the first velocity of the first state has a cotangent."""

    def save(self, ctrl, start, end):
        if not hasattr(self, "_first"):
            self._first = start.qpos[0].clone()
        return (*super().save(ctrl, start, end), (start.qpos == self._first).all(-1))

    def vjp(self, saved, cotangent, needs):
        *own, first = saved
        gradients = super().vjp(tuple(own), cotangent, needs)
        gradients.qvel[first & (cotangent.qvel[:, 0] != 0), 1] = float("nan")
        return gradients


_STEP = Stepper.step


def _nan_velocity(sim, ctrl, start, *rest, **named):
    end = _STEP(sim, ctrl, start, *rest, **named)
    end.qvel[1, 1] = float("nan")
    return end


def test_table_and_success(cartpole_file, capsys):
    assert run(main, [str(cartpole_file), *FAST]) == 0
    out = capsys.readouterr().out
    for text in ("ctrl", "qpos", "qvel", "rel_error", "cosine", "norm_ratio", "0 of 2 states left out", "ok"):
        assert text in out


def test_mode_is_taken(cartpole_file, capsys):
    assert run(main, [str(cartpole_file), *FAST, "--mode", "fd_jacobian", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mode"] == "fd_jacobian"


def test_a_config_stands_for_its_model(root, capsys):
    assert run(main, [str(root / "configs" / "cartpole.yaml"), *FAST]) == 0
    assert "configs/cartpole.yaml" in capsys.readouterr().out


def test_past_tolerance(cartpole_file, capsys):
    assert run(main, [str(cartpole_file), *FAST, "--tolerance", "1e-12"]) == 1
    assert "above the tolerance" in capsys.readouterr().out


def test_nonfinite_elements_are_named(cartpole_file, capsys, monkeypatch):
    """The gradient by the pole's velocity is NaN wherever the cart's velocity counts, at one of two states."""
    monkeypatch.setitem(BACKWARD_MODES, "tape_per_substep", NanSlope)
    assert run(main, [str(cartpole_file), *FAST]) == 1
    out = capsys.readouterr().out
    assert "non-finite: state 0 of random: the slope of qvel of joint slide by qvel of joint hinge\n" in out
    assert "largest relative error non-finite, tolerance 1.0e-02: above the tolerance" in out
    assert "inf" not in out.replace("non-finite", "")
    assert run(main, [str(cartpole_file), *FAST, "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["nonfinite"] == [
        {"state": "random", "world": 0, "results": ["qvel of joint slide"], "inputs": ["qvel of joint hinge"]}
    ]
    assert report["ok"] is False


def test_a_step_that_is_not_finite_fails_though_no_state_can_be_compared(cartpole_file, capsys, monkeypatch):
    monkeypatch.setattr(Stepper, "step", _nan_velocity)
    assert run(main, [str(cartpole_file), *FAST]) == 1
    out = capsys.readouterr().out
    assert "non-finite: state 1 of random: the step's qvel of joint hinge\n" in out


@pytest.mark.filterwarnings("ignore:.*approximate")
@pytest.mark.parametrize(("height", "share"), [(0.2, 1.0), (5.0, 0.0)])
def test_contacts_without_a_derivative_are_counted(tmp_path, capsys, height, share):
    """A capsule lies along a cylinder: their sides are parallel."""
    path = tmp_path / "stack.xml"
    path.write_text(f"""<mujoco><default><geom solref=".1 1"/></default><worldbody>
        <geom type="cylinder" size=".1 .1" euler="0 90 0"/>
        <body pos="0 0 {height}"><joint type="slide" axis="0 0 1"/>
        <geom type="capsule" size=".1 .05" euler="0 90 0"/></body></worldbody></mujoco>""")
    run(main, [str(path), "--states", "standing", "--worlds", "2", "--json"])
    assert json.loads(capsys.readouterr().out)["diagnostics"]["approximated_share"] == share
    run(main, [str(path), "--states", "standing", "--worlds", "2"])
    assert (
        f"approximated contacts, by the nearest law: in {share:.1%} of the substeps" in capsys.readouterr().out
    ) == (share > 0.0)


def test_json(cartpole_file):
    """In a process of its own: standard output must hold the object and nothing else."""
    command = [sys.executable, "-m", "msk_ray.gradcheck", str(cartpole_file), *FAST, "--substeps", "4", "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["model"], report["mode"]) == (str(cartpole_file), "tape_per_substep")
    assert (report["substeps"], report["worlds"], report["excluded"]) == (4, 2, 0)
    assert len(report["results"]) == 2 * 3
    for result in report["results"]:
        assert result.keys() >= {"state", "input", "rel_error", "cosine", "norm_ratio"}
        assert result["state"] == "random"
        assert result["input"] in ("ctrl", "qpos", "qvel")
    assert report["max_rel_error"] == max(r["rel_error"] for r in report["results"]) < 1e-2
    assert report["unsupported"] == []


def test_unsupported_model(tmp_path, capsys):
    path = tmp_path / "noslip.xml"
    path.write_text(UNSUPPORTED)
    assert run(main, [str(path), "--json"]) == 2
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert report["results"] == []
    assert report["max_rel_error"] is None
    assert "noslip" in report["unsupported"][0]
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1


def test_another_integrator_may_be_tried(tmp_path, capsys):
    path = tmp_path / "implicit.xml"
    path.write_text(
        '<mujoco><option integrator="implicit"/><worldbody><body><joint damping="1"/><geom size=".1"/>'
        "</body></worldbody></mujoco>"
    )
    assert run(main, [str(path), *FAST]) == 2
    assert 'Write integrator="Euler" or "implicitfast"; --integrator of gradcheck' in capsys.readouterr().err
    assert run(main, [str(path), *FAST, "--integrator", "implicitfast"]) == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--mode", "magic"], "fd_jacobian"),
        (["--states", "flying"], "standing, random, contact, policy"),
        (["--states", ","], "standing, random, contact, policy"),
        (["--seed", "-1"], "--seed"),
        (["--device", "abacus"], "abacus"),
        ([*FAST, "--forward-tolerance", "1e-30"], "2 of 2 states"),
    ],
)
def test_bad_input_is_one_line(cartpole_file, capsys, arguments, named):
    assert run(main, [str(cartpole_file), *arguments]) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


def test_room_is_taken_and_an_error_says_how_much_it_takes(tmp_path, capsys):
    path = tmp_path / "plate.xml"
    studs = "".join(f'<geom size=".02" pos="{x / 10} {y / 10} 0"/>' for x in range(4) for y in range(4))
    path.write_text(f"""<mujoco><worldbody><geom type="plane" size="5 5 1"/>
        <body pos="0 0 .019"><freejoint/>{studs}</body></worldbody></mujoco>""")
    command = [str(path), "--states", "standing", "--worlds", "2"]
    assert run(main, [*command, "--nconmax", "20", "--njmax", "16"]) == 2
    err = capsys.readouterr().err
    assert "njmax: 80 (now 16 constraint rows a world)" in err
    assert err.count("\n") == 1
    assert run(main, [*command, "--nconmax", "20", "--njmax", "80"]) == 0
    with pytest.raises(SystemExit):
        main([*command, "--njmax", "0"])


def test_bad_files(tmp_path, capsys):
    assert run(main, [str(tmp_path / "none.xml")]) == 2
    assert "no model file" in capsys.readouterr().err
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbdy/></mujoco>")
    assert run(main, [str(broken)]) == 2
    err = capsys.readouterr().err
    assert "worldbdy" in err
    assert err.count("\n") == 1


def test_numbers_are_checked_by_the_parser(cartpole_file, capsys):
    for flag in ("--worlds", "--substeps", "--tolerance"):
        with pytest.raises(SystemExit) as stop:
            main([str(cartpole_file), flag, "0"])
        assert stop.value.code == 2


def test_help_has_examples(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "examples:" in out
    assert "--substeps 16" in out


def test_parameters_are_compared_too(cartpole_file, capsys):
    assert run(main, [str(cartpole_file), *FAST, "--parameters", "body_mass, actuator_gear"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "random" in line]
    assert all(any(name in row for row in rows) for name in ("body_mass", "actuator_gear"))
    assert run(main, [str(cartpole_file), *FAST, "--parameters", "bodymass"]) == 2
    assert "did you mean body_mass?" in capsys.readouterr().err


def test_a_solver_that_has_not_converged_is_the_reason_that_nothing_could_be_compared(tmp_path, capsys):
    path = tmp_path / "hasty.xml"
    model = ant("elliptic")
    model.opt.iterations, model.opt.ls_iterations = 1, 5
    mujoco.mj_saveLastXML(str(path), model)
    command = [str(path), "--worlds", "2", "--states", "standing"]
    with pytest.warns(UserWarning, match="--iterations 1 --ls-iterations 5 in gradcheck"):
        assert run(main, command) == 0
    assert "had not converged" not in capsys.readouterr().out
    with pytest.warns(UserWarning, match="stopped before it had converged"):
        assert run(main, [*command, "--iterations", "1", "--ls-iterations", "5"]) == 2
    printed = capsys.readouterr()
    assert "the solver had not converged in " in printed.out
    assert "raise --iterations (now 1) and --ls-iterations (now 5)" in printed.err.splitlines()[-1]
