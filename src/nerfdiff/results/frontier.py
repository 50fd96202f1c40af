"""Frontier of configurations: those that nothing else beats."""

import numpy as np
from jaxtyping import Float


def frontier(cost: Float[np.ndarray, "n"], quality: Float[np.ndarray, "n"]) -> list[int]:
    """The Pareto frontier: those that no other equals or beats in both, and beats in one (cost lower, quality higher).

    Returns:
        their indices by growing cost, and so by growing quality. Of those with equal cost and quality all are there.
    """
    kept: list[int] = []
    for index in np.lexsort((-quality, cost)).tolist():
        last = kept[-1] if kept else None
        if (
            last is None
            or quality[index] > quality[last]
            or (cost[index], quality[index]) == (cost[last], quality[last])
        ):
            kept.append(index)
    return kept
