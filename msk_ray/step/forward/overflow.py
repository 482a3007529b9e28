"""Contacts and constraint rows that a step lost: detected on the device, and reported to the host."""

import math
from typing import Any

import numpy as np
import warp as wp
from mujoco_warp import OverflowType

from msk_ray.step.errors import SimulationError
from msk_ray.step.forward.capacity import Capacity

ITERATION_BITS = int(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)
"""The solver stopped at an iteration limit. This only costs accuracy, which the residual measures."""
_CONTACT_BITS = int(OverflowType.BROADPHASE | OverflowType.NARROWPHASE | OverflowType.CCD)
"""Overflows that room for more contacts fixes: pairs, contacts, and scratch for convex pairs are sized by it."""
_ROW_BITS = int(OverflowType.NEFC | OverflowType.NJMAX_NNZ)
"""Overflows that room for more rows fixes; it also sizes the non-zeros of a sparse Jacobian."""
_INCURABLE = {
    OverflowType.HFIELD: "a geom touches more cells of a height field than mujoco_warp keeps: give it coarser cells",
    OverflowType.EPA_HORIZON: "a contact of convex geoms was lost (EPA horizon): make their meshes simpler",
    OverflowType.CONTACT_MATCH: "a contact sensor saw more contacts than mujoco_warp keeps: add <numeric "
    "name='contact_sensor_maxmatch' data='256'/> to <custom> of the model",
    OverflowType.NVMAX: "more degrees of freedom were awake than mujoco_warp has room for: disable sleeping",
}
# Without TACTILE, of sensors that nothing reads.
LOST_BITS = _CONTACT_BITS | _ROW_BITS | int(sum(_INCURABLE))
_NAN = wp.constant(math.nan)


@wp.kernel(enable_backward=False)
def note_losses(
    # In:
    overflow_in: wp.array[int],
    nefc_in: wp.array[int],
    nacon_in: wp.array[int],
    ncollision_in: wp.array[int],
    lost_bits: int,
    # Out:
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    act_out: wp.array2d[float],
    peaks_out: wp.array[int],
    heard_out: wp.array[int],
) -> None:
    """Per world: update the peaks; if the step lost something, set its results to NaN and set a flag on the host."""
    world = wp.tid()
    if nefc_in[world] > peaks_out[1]:
        wp.atomic_max(peaks_out, 1, nefc_in[world])
    if world == 0:
        peaks_out[0] = wp.max(peaks_out[0], wp.max(nacon_in[0], ncollision_in[0]))
    if (overflow_in[world] & lost_bits) != 0:
        for i in range(qpos_out.shape[1]):
            qpos_out[world, i] = _NAN
        for i in range(qvel_out.shape[1]):
            qvel_out[world, i] = _NAN
        for i in range(act_out.shape[1]):
            act_out[world, i] = _NAN
        heard_out[0] = 1


class LossWatch:
    """Watches one batch's Data. On CUDA its kernel writes to pinned host memory, and only after a loss, so that a check
    is one read by the host, and the device never waits.

    Args:
        data: the batch's mujoco_warp.Data.
        device: its device.
    """

    def __init__(self, data: Any, device: wp.Device) -> None:
        self._data = data
        self._device = device
        self._peaks = wp.zeros(2, dtype=int, device=device)
        # Pinned memory has the same address for host and device.
        self._host = wp.zeros(1, dtype=int, device="cpu", pinned=device.is_cuda)
        self._heard_view = self._host.numpy()
        self._heard = wp.array(ptr=self._host.ptr, dtype=int, shape=(1,), device=device, copy=False)

    def launch(self, data: Any) -> None:
        """Launch the check of an env step whose last substep was computed in `data`; results are in the batch's own
        Data."""
        own = self._data
        wp.launch(
            note_losses,
            dim=own.nworld,
            inputs=[own.overflow, data.nefc, data.nacon, data.ncollision, LOST_BITS],
            outputs=[own.qpos, own.qvel, own.act, self._peaks, self._heard],
            device=self._device,
        )

    def any_lost(self) -> bool:
        """Whether a finished step lost anything. Does not wait for running steps."""
        return bool(self._heard_view[0])

    def read(self) -> tuple[int, float, Capacity]:
        """Since the last read: bits of what was lost, share of worlds at a solver limit, and peak use of the buffers.

        Waits for the steps, and resets the values.
        """
        bits = np.array(self._data.overflow.numpy())  # a copy: on CPU, numpy() is a view
        contacts, rows = (int(n) for n in self._peaks.numpy())
        self._data.overflow.zero_()
        self._peaks.zero_()
        if self._device.is_cuda:
            wp.synchronize_stream(self._device.stream)  # not the whole device, where other streams may be running
        self._heard_view[0] = 0
        lost = int(np.bitwise_or.reduce(bits)) & LOST_BITS
        limited = float(np.mean((bits & ITERATION_BITS) != 0))
        return lost, limited, Capacity(-(-contacts // self._data.nworld), rows)


def needed(lost: int, now: Capacity, peak: Capacity) -> Capacity:
    """Room to try next after losing `lost`: twice what was too small, or more if the step asked for more."""
    wanted = now
    if lost & _CONTACT_BITS:
        wanted = wanted._replace(contacts=max(2 * now.contacts, peak.contacts * 5 // 4))
    if lost & _ROW_BITS:
        wanted = wanted._replace(rows=max(2 * now.rows, peak.rows * 5 // 4))
    return wanted


def cured(lost: int, now: Capacity, allowed: Capacity) -> bool:
    """Whether `allowed` is larger in everything that was lost."""
    if lost & ~(_CONTACT_BITS | _ROW_BITS):
        return False
    contacts = not lost & _CONTACT_BITS or allowed.contacts > now.contacts
    return contacts and (not lost & _ROW_BITS or allowed.rows > now.rows)


def loss_error(lost: int, now: Capacity, wanted: Capacity) -> SimulationError:
    """The error for what was lost, with what to write."""
    for bit, advice in _INCURABLE.items():
        if lost & int(bit):
            return SimulationError(f"mujoco_warp lost contacts: {advice}")
    settings = []
    if lost & _CONTACT_BITS:
        settings.append(f"execution.nconmax: {wanted.contacts} (now {now.contacts} contacts a world)")
    if lost & _ROW_BITS:
        settings.append(f"execution.njmax: {wanted.rows} (now {now.rows} constraint rows a world)")
    return SimulationError(
        f"a step lost contacts or constraint rows, so its results are no state: write {' and '.join(settings)}; in "
        "Python, give the Simulation a capacity, and on the command line of gradcheck --nconmax and --njmax"
    )
