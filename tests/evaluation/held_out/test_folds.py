import itertools

import equinox as eqx
import numpy as np
import pytest

from smartview_jax.evaluation import compare, held_out, region_folds, split_views


def test_views_that_lie_together_are_hidden_together():
    """Four heaps far apart, their views in no order: each is a region."""
    rng = np.random.default_rng(3)
    heap = rng.permutation(np.arange(20) % 4)
    corners = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.0, 0.0, 0.4], [0.9, 0.0, 0.4]])
    positions = corners[heap] + 0.02 * rng.normal(size=(20, 3))
    names = np.arange(100, 120)
    expected = {tuple(names[heap == k]) for k in range(4)}
    assert set(region_folds(names, positions, 4)) == expected
    # Where the base frame stands and how it is turned is of no consequence.
    assert set(region_folds(names, 5.0 - positions[:, [2, 0, 1]], 4)) == expected


@pytest.mark.parametrize("folds", [2, 3, 5, 7])
@pytest.mark.parametrize("count", [6, 7, 8, 15, 28, 41])
def test_regions_are_of_one_size_and_hold_every_view_once(count, folds):
    positions = np.random.default_rng(count).normal(size=(count, 3))
    regions = region_folds(np.arange(count), positions, folds)
    sizes = [len(region) for region in regions]
    assert sorted(itertools.chain(*regions)) == list(range(count))
    assert len(sizes) == min(folds, count // 2)
    assert min(sizes) >= 2
    assert max(sizes) - min(sizes) <= 1


def test_a_hidden_region_is_tighter_than_random_views(scene):
    positions = np.asarray(scene.data.base_from_tool.translation())

    def spread(folds):
        return np.mean([positions[list(fold)].var(axis=0).sum() for fold in folds])

    regions, random = (split_views(scene.data, 5, by) for by in ("region", "view"))
    assert spread(regions) < 0.6 * spread(random)


def test_regions_are_of_the_views_that_can_be_used(scene):
    hidden = np.array(scene.data.visible)
    hidden[4] = False
    data = eqx.tree_at(lambda d: d.visible, scene.data, scene.data.visible & hidden)
    assert sorted(itertools.chain(*split_views(data, 5, "region"))) == [0, 1, 2, 3, *range(5, 16)]


def test_the_same_regions_are_hidden_from_every_method(scene):
    regions = split_views(scene.data, 3, "region")
    assert held_out(scene.data, lambda _: scene.calibration, 3, by="region").folds == regions
    methods = {name: lambda _: scene.calibration for name in ("one", "other")}
    for row in compare(scene.data, methods, 3, by="region"):
        assert row.held_out.folds == regions


def test_what_cannot_be_split_says_why(scene):
    with pytest.raises(ValueError, match="by is one of view, region; found 'pose'"):
        split_views(scene.data, 5, "pose")
    few = scene.data.select(range(5))
    with pytest.raises(ValueError, match="by region needs at least 6 usable views, found 5"):
        split_views(few, 5, "region")
