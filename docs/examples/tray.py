"""A waiter's task: bring a tray to the middle as fast as the puck on it allows."""

import torch
from torch import Tensor

from msk_ray import MjcfEnv, Reward, StepState


class TrayReward(Reward):
    near: float = 1.0
    """Weight of how near the tray is to the middle, from 0 to 1."""
    slip: float = 3.0
    """Weight of the speed of the puck on the tray [s/m]."""
    effort: float = 0.01
    """Weight of the squared action."""


class Tray(MjcfEnv):
    class Settings(MjcfEnv.Settings):
        distance: float = 0.5
        """Largest distance of the tray from the middle at the start [m]."""
        reward: TrayReward = TrayReward()

    reward_names = ("near", "slip", "effort")
    mjcf = """
    <mujoco model="tray"><option timestep=".005" cone="elliptic"/>
      <default><geom friction=".8 .005 .0001"/></default>
      <worldbody><light pos="0 -2 4" dir="0 .4 -1"/>
        <camera name="side" pos="0 -1.8 .6" xyaxes="1 0 0 0 0 1"/>
        <body name="tray" pos="0 0 .5"><joint name="tray" type="slide" axis="1 0 0" damping=".1"/>
          <geom name="tray" type="box" size=".05 .1 .01" mass="2" rgba=".5 .35 .2 1"/></body>
        <body name="puck" pos="0 0 .54"><joint name="puck_x" type="slide" axis="1 0 0"/>
          <joint name="puck_z" type="slide" axis="0 0 1"/>
          <geom name="puck" type="sphere" size=".03" mass=".5" rgba=".8 .2 .2 1"/></body></worldbody>
      <actuator><motor joint="tray" gear="40" ctrlrange="-1 1"/></actuator></mujoco>"""

    def draw_physics(self, count: int) -> StepState:
        side = self.uniform(count, 1)
        tray = self.config.distance * (0.6 * side.sign() + 0.4 * side)
        qpos = torch.cat((tray, tray, torch.zeros_like(tray)), dim=-1)
        return StepState(qpos, torch.zeros_like(qpos), torch.zeros((count, 0), device=self.device))

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.stack((state.qpos[:, 0], state.qvel[:, 0]), dim=-1)  # it does not see the puck

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        r = self.config.reward
        near = 1.0 / (1.0 + (state.qpos[:, 0] / 0.1).square())
        slip = (state.qvel[:, 1] - state.qvel[:, 0]).square().add(1e-4).sqrt() - 1e-2
        return torch.stack((r.near * near, -r.slip * slip, -r.effort * action.square().sum(-1)), dim=-1)

    def fell(self, state: StepState) -> Tensor:
        return (state.qpos[:, 1] - state.qpos[:, 0]).abs() > 0.05
