import numpy as np

from smartview_jax.features import grouped_indices


def test_members_are_numbered_group_by_group():
    counts = np.array([3, 0, 1, 4])
    group, place = grouped_indices(counts)
    numbered = [(g, k) for g, count in enumerate(counts) for k in range(count)]
    assert list(zip(group, place, strict=True)) == numbered


def test_without_groups_there_are_no_members():
    assert [len(part) for part in grouped_indices(np.zeros(0, int))] == [0, 0]
