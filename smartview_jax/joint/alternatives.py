"""Which models of the robot's error are tried on a set of views, and which of them is believed."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..compilation import compiled, optimised
from ..dataset import Dataset
from ..robots import (
    AbstractField,
    Command,
    DHErrors,
    ImpliedArm,
    LinearInPose,
    Stretched,
    field_name,
)
from .likelihood import LinearisedViews, Sizes
from .scoring import Likeliest, likeliest

FEW = 8
"""Views below which white noise of poses is hard to tell from errors of the camera.

There a model of the robot's error has to be believable besides, or far likelier than white noise.
Real sets left out view by view: six views of koide_charuco 20230920 err by 2.1 px where they erred
by 3.2 as long as the robot was trusted; seven of 20231006, where white noise is not believable, by
1.34 and not 1.8. Five simulated ones with white noise: 1.53 and 2.03.
"""

BELIEVABLE = 3.0
"""Times the sigma of pixels within views that the effective one may be.

A model that is true leaves none of what views disagree in to their pixels. Simulated, it is 1 to 2
times; where the camera's errors pass for the robot's, on real sets, 4 to 10.
"""

DECISIVE = 10.0
"""Deviance, more than white noise gains, for which a field needs not be believable."""

ENOUGH_FOR_ARM = 10
"""Views from which an arm that nobody described is tried.

It has one size fewer than a field linear in the pose, and fits few views too well: eight of
visp_franka_eih, an arm of seven joints, are likelier by it and err by a fifth more.
"""

PENALTY = 2.0
"""Deviance that each further size of the field has to gain where views are many: Akaike's.

Where there is nothing to find a size gains but half a chi-square's, since half of the time the best
size is zero. But a field that is not there costs more than a small one that is missed: at a price
of one it was taken in one of twenty simulations with white noise alone, at 8 to 25 views, and
their error on unseen views grew by two thirds (`python -m benchmarks regimes`).

With few views it is dearer, `1 + (FEW / views)^2` times: at eight, Akaike's is paid by chance in
one of ten. Below, a model has to be believable instead.
"""

DEARER = 1.25
"""Times Akaike's price below eight views.

At its own, one of forty simulations of five views and little noise was given a field by chance; at
1.5 times, a robot that does err, six views of koide_charuco 20230920, by 2.25 px instead of 2.08.
"""

STRETCH_GAINS = 13.0
"""Deviance that a stretch of all ways beside the field has to gain.

It is one number that robots and targets often have wrong, and that a field takes for one of many:
with it, unseen views of visp_franka_eih err by half as much (it gains 33 there). But where there is
nothing of the kind, what arms do looks like it: it gains up to 11 from simulated ones that err in
their links, and from tampere_kuka_2, whose halves then put the camera 0.9 mm apart, not 0.4.
"""

TOO_LARGE = 5.0
"""Times the first guess."""

PLAIN = ("trusted", "white")
"""Alternatives without a field."""


class Tried(NamedTuple):
    """A model of the robot's error, and the sizes of errors that make it likeliest.

    Attributes:
        basis: the field that it was tried with; it may use its first groups alone.
        active: which of translation, rotation, and groups of the basis have a size.
        found: the likeliest sizes.
    """

    basis: AbstractField | None
    active: Bool[np.ndarray, "robot"]
    found: Likeliest

    @property
    def field(self) -> AbstractField | None:
        """The part of the basis that has a size; None where none has."""
        groups = int(self.active[2:].sum())
        if self.basis is None or not groups:
            return None
        return next(part for part in self.basis.nested if len(part.groups) == groups)


def largest_field(data: Dataset) -> AbstractField:
    """That of the arm itself where its joints are known, otherwise linear in the pose."""
    if data.arm is not None:
        return DHErrors(data.arm)
    return LinearInPose.over(read_poses(data))


def read_poses(data: Dataset) -> SE3:
    """Without what stands in for a pose that could not be read: it is nowhere near the others."""
    masked = {view for view, _ in data.masked_views}
    read = np.array([view not in masked for view in data.view_ids])
    return SE3(data.base_from_tool.wxyz_xyz[read])


def believed(
    views: LinearisedViews,
    data: Dataset,
    asked: AbstractField | Literal[False] | None,
    basis: AbstractField | None,
    scatter: Float[np.ndarray, "placed 6"],
) -> tuple[str, dict[str, Tried]]:
    """Name of the model that is believed, and every one that was tried.

    Args:
        views: linearised with the basis.
        data: whose views they are.
        asked: as `estimate_noise` has it; a field that is asked for is believed.
        basis: of the field; None where there is none.
        scatter: of the placed views' own best poses about the start's chain.
    """
    tried = _nested(views, asked, basis, scatter)
    if asked is not None:
        return list(tried)[-1], tried
    # Who holds the robot's error asks for none.
    undescribed = data.arm is None and bool(np.any(np.asarray(views.group) >= 0))
    command, read = data.observations.command, read_poses(data)
    if undescribed and len(scatter) >= ENOUGH_FOR_ARM:
        arm = ImpliedArm.over(read)
        guess = _first_guess(scatter, arm, views).field
        tried[field_name(arm)] = _instead(views, command, arm, tried["white"], TOO_LARGE * guess)
    name = _choice(tried, float(views.white_sigma), len(scatter))
    field = tried[name].field
    if undescribed and field is not None:
        stretched, found = Stretched.over(field, read), tried[name].found
        guess = _first_guess(scatter, stretched, views).field[-1:]
        known = found.sizes.field[: len(field.groups)]
        begin = jnp.concatenate([known, TOO_LARGE * guess])
        other = f"stretched {name}"
        tried[other] = _instead(views, command, stretched, tried[name], begin)
        if gain(tried, other) - gain(tried, name) >= STRETCH_GAINS:
            name = other
    return name, tried


def gain(tried: dict[str, Tried], name: str) -> float:
    """Deviance of one below that of a robot that is trusted."""
    return float(tried["trusted"].found.deviance - tried[name].found.deviance)


def _nested(
    views: LinearisedViews,
    asked: AbstractField | Literal[False] | None,
    basis: AbstractField | None,
    scatter: Float[np.ndarray, "placed 6"],
) -> dict[str, Tried]:
    """The likeliest sizes of every model that the basis has, each containing the one before.

    A field that is not asked for is tried only where the views' poses have numbers enough for its
    coefficients and the chain's twelve.
    """
    place = np.arange(2 + (0 if basis is None else len(basis.groups)))
    masks = {"trusted": place < 0, "white": place < 2}
    if asked is None and basis is not None:
        for part in basis.nested:
            if 6 * len(scatter) >= part.size + 12:
                masks[field_name(part)] = place < 2 + len(part.groups)
    elif basis is not None:
        masks[field_name(basis)] = place >= 0
    return _searched(views, basis, masks, _first_guess(scatter, basis, views))


def _instead(
    views: LinearisedViews,
    command: Command,
    field: AbstractField,
    known: Tried,
    begin: Float[jax.Array, "groups"],
) -> Tried:
    """A field in the place of the one that the views were linearised with.

    Args:
        views: linearised, with any field.
        command: as reported, of all views.
        field: to try.
        known: where the sizes of pixels and of poses begin.
        begin: where the field's own do.
    """
    group = np.repeat(np.arange(len(field.groups)), [count for _, count in field.groups])
    others = int(np.sum(np.asarray(views.group) < 0))
    there = views.with_field(_twists(field, command), group, others)
    sizes = eqx.tree_at(lambda s: s.field, known.found.sizes, begin)
    active = np.ones(2 + len(field.groups), dtype=bool)
    return Tried(field, active, search(there, sizes, jnp.asarray(active)))


def _choice(tried: dict[str, Tried], white_sigma: float, views: int) -> str:
    """Trusted, white, or a field; of nested ones the largest: its groups switch themselves off."""
    price = PENALTY * (1.0 + (FEW / views) ** 2 if views >= FEW else DEARER)

    def believable(name: str) -> bool:
        return views >= FEW or float(tried[name].found.sizes.pixel) <= BELIEVABLE * white_sigma

    def worth(name: str) -> float:
        return gain(tried, name) - price * tried[name].active.sum()

    # By basis, the last is the largest; without a field there is one all the same.
    largest = {id(one.basis): name for name, one in tried.items()}
    field = max(largest.values(), key=worth)
    likelier = field not in PLAIN and worth(field) >= worth("white")
    if likelier and (believable(field) or gain(tried, field) - gain(tried, "white") >= DECISIVE):
        return field
    return "white" if worth("white") >= 0.0 and believable("white") else "trusted"


def _first_guess(
    scatter: Float[np.ndarray, "placed 6"], basis: AbstractField | None, views: LinearisedViews
) -> Sizes:
    """From how the placed views' own best poses scatter about the start's chain."""
    size = np.median(np.abs(scatter).reshape(-1, 2, 3), axis=(0, 2))
    translation, rotation = np.maximum(size, 1e-6)
    groups = [] if basis is None else [name for name, _ in basis.groups]
    field = [translation if name.startswith("translation") else rotation for name in groups]
    return Sizes.of(jnp.array([3.0 * float(views.white_sigma), translation, rotation, *field]))


def _searched(
    views: LinearisedViews,
    basis: AbstractField | None,
    masks: dict[str, Bool[np.ndarray, "robot"]],
    guess: Sizes,
) -> dict[str, Tried]:
    """Each from where the one before ended, with what is new far too large.

    A size near zero has next to no slope. Where that ends worse, the one before is kept.
    """
    tried: dict[str, Tried] = {}
    previous, begin = None, guess
    for name, active in masks.items():
        found = search(views, begin, jnp.asarray(active))
        if previous is not None and previous.deviance < found.deviance:
            found = previous
        previous = found
        tried[name] = Tried(basis, active, found)
        if active.any():
            known = np.concatenate([[True], active])
            begin = Sizes.of(jnp.where(known, found.sizes.numbers, TOO_LARGE * guess.numbers))
    return tried


@compiled
def _twists(field: AbstractField, command: Command) -> Float[jax.Array, "views 6 coefficients"]:
    return field.by_coefficients(command, jnp.zeros(field.size))


search = optimised(likeliest)
