"""Motions: files that are read and refused, resampling, poses and velocities of bodies, mirror images, remarks."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from msk_ray.errors import ConfigError
from msk_ray.robots.tracking import motions
from msk_ray.robots.tracking.motion_remarks import hovering, remarks
from msk_ray.robots.tracking.motions import Clip, Motion, body_names, read_motion, read_motions, slerp

SCENE = Path(__file__).parents[3] / "msk_ray" / "robots" / "scenes" / "g1_flat.xml"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(SCENE))


@pytest.fixture(scope="module")
def squat(model: mujoco.MjModel) -> Motion:
    (motion,) = read_motions("builtin:squat", model)
    return motion


def write_csv(path: Path, motion: Motion) -> Path:
    rows = np.concatenate((motion.position, motion.orientation[:, [1, 2, 3, 0]], motion.joints), axis=1)
    np.savetxt(path, rows, delimiter=",", fmt="%.6f")
    return path


def test_csv_and_npz_are_read_as_they_were_written(tmp_path: Path, model: mujoco.MjModel, squat: Motion) -> None:
    from_csv = read_motion(write_csv(tmp_path / "squat.csv", squat), model)
    Clip.of(squat, model).save(tmp_path / "squat.npz")
    from_npz = read_motion(tmp_path / "squat.npz", model)
    for motion in (from_csv, from_npz):
        assert (motion.name, motion.rate, len(motion)) == ("squat", 30.0, 121)
        np.testing.assert_allclose(motion.qpos, squat.qpos, atol=2e-6)
    assert [motion.name for motion in read_motions(str(tmp_path), model)] == ["squat", "squat"]


def test_files_without_a_motion_of_this_robot_are_refused(tmp_path: Path, model: mujoco.MjModel, squat: Motion) -> None:
    def refused(match: str, **changes: np.ndarray) -> None:
        with pytest.raises(ConfigError, match=match):
            read_motion(write_csv(tmp_path / "bad.csv", replace(squat, **changes)), model)

    refused("35 numbers a frame, not 36: .* and 29 joints, from left_hip_pitch", joints=squat.joints[:, :-1])
    refused(
        "2 frames; a motion has 3", **{name: getattr(squat, name)[:2] for name in ("position", "orientation", "joints")}
    )
    refused("columns 4 to 7 of frame .* no unit quaternion", orientation=1.1 * squat.orientation)
    refused("frame 0 is not finite", position=np.full_like(squat.position, np.nan))
    refused(
        "column 14 is up to .* beyond the range of right_hip_pitch_joint",
        joints=squat.joints + 4.0 * (np.arange(29) == 6),
    )
    (tmp_path / "bad.csv").write_text("a,b\n")
    with pytest.raises(ConfigError, match="not a table of numbers"):
        read_motion(tmp_path / "bad.csv", model)
    np.savez(tmp_path / "bad.npz", fps=np.array([object()], dtype=object))
    with pytest.raises(ConfigError, match="not a file of mjlab's csv_to_npz"):
        read_motion(tmp_path / "bad.npz", model)
    np.savez(tmp_path / "bad.npz", fps=np.array([50.0]))
    with pytest.raises(ConfigError, match="body_pos_w"):
        read_motion(tmp_path / "bad.npz", model)
    with pytest.raises(ConfigError, match=r"no motion 'jump' in /.*: write a file .* or builtin:squat"):
        read_motions("jump", model)
    with pytest.raises(ConfigError, match="the built-in ones are builtin:squat"):
        read_motions("builtin:jump", model)


def test_files_that_are_too_large_are_not_read(
    tmp_path: Path, model: mujoco.MjModel, squat: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motions, "_MAX_BYTES", 2**20)
    write_csv(tmp_path / "long.csv", replace(squat, joints=np.repeat(squat.joints, 1, axis=0)))
    np.savez_compressed(tmp_path / "bomb.npz", fps=np.array([50.0]), joint_pos=np.zeros((2**16, 29)))
    with pytest.raises(ConfigError, match="its content is larger than 1 MiB"):
        read_motion(tmp_path / "bomb.npz", model)
    monkeypatch.setattr(motions, "_MAX_BYTES", 1000)
    with pytest.raises(ConfigError, match="larger than 0 MiB"):
        read_motion(tmp_path / "long.csv", model)


def test_resampling_hardly_changes_a_smooth_motion(squat: Motion) -> None:
    faster = squat.at_rate(50.0)
    assert len(faster) == 200  # 4 s without the last frame
    times = np.arange(200) / 50.0
    knee = 3
    down = (1.0 - np.cos(2.0 * np.pi * times / 4.0)) / 2.0
    np.testing.assert_allclose(faster.joints[:, knee], squat.joints[0, knee] + down, atol=2e-3)
    assert faster.at_rate(50.0) is faster


def test_slerp_turns_evenly_along_the_shorter_arc() -> None:
    def about_z(angle: float) -> np.ndarray:
        return np.array([[np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)]])

    for start, end in ((0.2, 1.4), (0.2, 0.2), (3.0, 3.4)):
        for sign in (1.0, -1.0):
            turned = slerp(about_z(start), sign * about_z(end), np.array([[0.25]]))
            np.testing.assert_allclose(turned, about_z(start + 0.25 * (end - start)), atol=1e-12)


def test_body_poses_are_c_mujocos_and_velocities_their_differences(model: mujoco.MjModel, squat: Motion) -> None:
    turning = squat.at_rate(50.0)
    yaw = np.linspace(0.0, 2.0, len(turning))
    spun = np.stack((np.cos(yaw / 2.0), 0.0 * yaw, 0.0 * yaw, np.sin(yaw / 2.0)), axis=-1)
    clip = Clip.of(replace(turning, orientation=spun), model)
    data = mujoco.MjData(model)
    for frame in (0, 57, 199):
        data.qpos[:] = clip.motion.qpos[frame]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(clip.position[frame], data.xpos[-30:], atol=1e-5)
        np.testing.assert_allclose(clip.orientation[frame], data.xquat[-30:], atol=1e-5)
    differences = np.gradient(clip.position, 0.02, axis=0)
    np.testing.assert_allclose(clip.velocity[1:-1], differences[1:-1], atol=2e-3)
    np.testing.assert_allclose(clip.angular_velocity[:, 0, 2], 2.0 / (199 * 0.02), rtol=1e-4)
    assert body_names(model)[0] == "pelvis"


def test_mirroring_a_motion_mirrors_every_body(model: mujoco.MjModel, squat: Motion) -> None:
    clip, image = Clip.of(squat, model), Clip.of(squat.mirrored(model), model)
    names = body_names(model)
    partner = [names.index(motions._other_side(name)) for name in names]
    np.testing.assert_allclose(image.position, clip.position[:, partner] * (1.0, -1.0, 1.0), atol=1e-4)
    np.testing.assert_allclose(squat.mirrored(model).mirrored(model).qpos, squat.qpos)


def test_cutting_keeps_the_part_between_two_times(squat: Motion) -> None:
    part = squat.cut(1.0, 2.0)
    assert len(part) == 31
    np.testing.assert_array_equal(part.joints[0], squat.joints[30])
    with pytest.raises(ConfigError, match=r"env.cut: squat is 4.00 s long, and 5 to 6 s has fewer than 3 frames"):
        squat.cut(5.0, 6.0)


def test_remarks_name_joints_out_of_range_and_parts_in_the_ground_or_in_each_other(
    model: mujoco.MjModel, squat: Motion
) -> None:
    assert remarks(squat, model) == []
    sunk = replace(squat, position=squat.position - (0.0, 0.0, 0.05))
    (remark,) = remarks(sunk, model)
    assert remark.startswith("up to 5 cm in the ground")
    bent = squat.joints.copy()
    bent[:10, 14] = 0.6  # waist_pitch_joint, range 0.52
    (remark,) = remarks(replace(squat, joints=bent), model)
    assert remark == "waist_pitch_joint up to 0.08 rad beyond its range, any joint in 8%"
    crossed = squat.joints.copy()
    crossed[:, 1], crossed[:, 7] = -0.3, 0.3  # hips roll the legs into each other
    crossed_legs = replace(squat, joints=crossed, position=np.add(squat.position, (0.0, 0.0, 0.5)))
    in_itself, hovers = remarks(crossed_legs, model)
    assert in_itself.endswith("cm in itself, over 3 cm in 100%")
    assert hovers == "hovers for 4.0 s, 4.0 s of it from 0.0 s"


@pytest.mark.parametrize(("gravity", "spans"), [(9.81, []), (3.0, [(1.0, 0.5)])])
def test_a_jump_hovers_if_it_falls_more_slowly_than_gravity_allows(
    gravity: float, spans: list[tuple[float, float]], model: mujoco.MjModel, squat: Motion
) -> None:
    frames = np.arange(30, 45)  # 0.5 s from 1 s on; at the jump's ends the feet are 5 cm above the ground
    times = (frames - 37) / squat.rate
    standing, position = (np.repeat(values[:1], len(squat), axis=0) for values in (squat.joints, squat.position))
    position[frames, 2] += 0.05 + 0.5 * gravity * (times[0] ** 2 - times**2)
    jump = replace(squat, joints=standing, position=position)
    assert hovering(jump, model) == spans
