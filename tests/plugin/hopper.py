"""A planar hopper on one leg: an environment with its own model and reward, in one file outside the package."""

import torch
from torch import Tensor

from msk_ray import MjcfEnv, Reward, StepState


class HopperReward(Reward):
    forward: float = 1.0
    """Weight of the forward velocity of the centre of mass [s/m]."""
    upright: float = 1.0
    """Weight of the cosine between the torso's axis and the vertical."""
    effort: float = 0.05
    """Weight of the mean squared action."""
    impact: float = 0.01
    """Weight of the floor's force on the foot [1/kN]; it has no gradient."""


class Hopper(MjcfEnv):
    class Settings(MjcfEnv.Settings):
        min_height: float = 0.7
        """Height of the torso below which an episode ends [m]."""
        reward: HopperReward = HopperReward()

    reward_names = ("forward", "upright", "effort", "impact")
    without_gradient = ("impact",)
    mjcf = """
    <mujoco model="hopper"><option timestep=".005" integrator="implicitfast" cone="elliptic"/>
      <default><joint damping="1" armature=".02"/><geom contype="0" conaffinity="0" density="900" rgba=".8 .5 .2 1"/>
        <motor ctrlrange="-1 1" gear="80"/></default>
      <worldbody><light pos="0 -2 4" dir="0 .4 -1"/>
        <geom name="floor" type="plane" size="20 20 1" rgba=".4 .5 .6 1" conaffinity="1"/>
        <body name="torso" pos="0 0 1.13">
          <camera name="side" mode="track" pos="0 -4 0" xyaxes="1 0 0 0 0 1"/>
          <joint name="x" type="slide" axis="1 0 0" damping="0" armature="0"/>
          <joint name="z" type="slide" axis="0 0 1" damping="0" armature="0"/>
          <joint name="pitch" axis="0 1 0" damping="0" armature="0"/>
          <geom type="capsule" fromto="0 0 -.15 0 0 .25" size=".06"/>
          <body pos="0 0 -.2"><joint name="hip" axis="0 -1 0" range="-60 60"/>
            <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".05"/>
            <body pos="0 0 -.4"><joint name="knee" axis="0 -1 0" range="-120 0"/>
              <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04"/>
              <body name="foot" pos="0 0 -.4"><joint name="ankle" axis="0 -1 0" range="-45 45"/>
                <geom name="foot" type="capsule" fromto="-.1 0 -.08 .2 0 -.08" size=".05" contype="1"/>
              </body></body></body></body></worldbody>
      <actuator><motor joint="hip"/><motor joint="knee"/><motor joint="ankle" gear="30"/></actuator></mujoco>"""

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        foot = self.frames(state).position("foot") - self.frames(state).position("torso")
        return torch.cat((state.qpos[:, 1:], 0.1 * state.qvel, foot[:, ::2], action), dim=-1)

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        r, frames = self.config.reward, self.frames(state)
        speed, up = frames.com_velocity()[:, 0], frames.axis("torso", 2)[:, 2]
        impact = -r.impact * self.contact_forces(state, "foot").norm(dim=-1) / 1000.0
        return torch.stack((r.forward * speed, r.upright * up, -r.effort * action.square().mean(-1), impact), dim=-1)

    def fell(self, state: StepState) -> Tensor:
        return self.frames(state).position("torso")[:, 2] < self.config.min_height
