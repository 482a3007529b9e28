"""Which contacts one thread takes: its own, or one after the other all of a world, whose sums then have one order."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def contacts_end(first: int, in_turn: bool, nacon: int, worldid_in: wp.array[int]) -> int:
    """One past the last contact of the thread that begins with `first`; `first` itself where another takes it.

    `in_turn` needs contacts that are sorted by their worlds: the first one's thread takes all of a world.
    """
    count = wp.min(nacon, worldid_in.shape[0])
    if first >= count:
        return first
    if not in_turn:
        return first + 1
    world = worldid_in[first]
    if first > 0:
        if worldid_in[first - 1] == world:
            return first
    end = first + 1
    while end < count:
        if worldid_in[end] != world:
            break
        end += 1
    return end
