"""Which terms of a reward have a gradient, read from the graph that autograd keeps.

Axes: W worlds, T terms.
"""

import math

import torch
from torch import Tensor
from torch.autograd.graph import GradientEdge, Node

_ASSEMBLING = frozenset(
    f"{name}Backward0"
    for name in (
        *("Stack", "Cat", "Mul", "Div", "Neg", "Add", "Sub", "Unsqueeze", "Squeeze", "Transpose", "T", "Permute"),
        *("View", "UnsafeView", "ReshapeAlias", "Clone", "ToCopy", "Expand", "Select", "Slice", "AsStrided"),
    )
) | {"CopySlices", "CopyBackwards", "SqueezeBackward1"}
"""Operations that put terms side by side or weight them; they hand every cotangent on to all that they are made of."""


def terms_without_gradient(terms: Tensor) -> list[int]:
    """The columns of terms (W, T) that depend on nothing with a gradient, whatever the state.

    A term whose gradient is 0 in this state, such as a cost beyond a bound, is none of them: NaN is sent back to one
    column after the other, only through operations that assemble columns. They let it pass even where a weight is 0, so
    that it arrives at every operation that the column is made of.
    """
    if not terms.requires_grad:
        return list(range(terms.shape[1]))
    ends = _where_assembling_ends(terms)
    without = []
    for column in range(terms.shape[1]):
        # Given a cotangent, torch would load its symbolic shapes, which takes most of a second.
        sent = terms[:, column].sum() * math.nan
        arrived = torch.autograd.grad(sent, ends, retain_graph=True, allow_unused=True)
        if not any(bool(part.isnan().any()) for part in arrived if part is not None):
            without.append(column)
    return without


def _where_assembling_ends(terms: Tensor) -> list[GradientEdge]:
    """The inputs of the last assembling operations on the way back from `terms`."""
    root = torch.autograd.graph.get_gradient_edge(terms)
    ends: dict[tuple[Node, int], GradientEdge] = {}
    waiting, seen = [root], set()
    while waiting:
        edge = waiting.pop()
        if edge.node.name().rsplit("::")[-1] not in _ASSEMBLING:
            ends[edge.node, edge.output_nr] = edge
        elif edge.node not in seen:
            seen.add(edge.node)
            waiting += [GradientEdge(node, number) for node, number in edge.node.next_functions if node is not None]
    return list(ends.values())
