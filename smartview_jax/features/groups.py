"""Groups of different sizes in one array: the members of the first group, then of the second."""

import numpy as np
from jaxtyping import Int


def grouped_indices(
    counts: Int[np.ndarray, "groups"],
) -> tuple[Int[np.ndarray, "members"], Int[np.ndarray, "members"]]:
    """Return the group of each member, and its place within the group, one group after the other.

    Args:
        counts: number of members of each group; a group may be empty.

    For example:

        >>> sv.features.grouped_indices(np.array([2, 0, 3]))
        (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]
