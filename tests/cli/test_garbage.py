"""Commands look for garbage rarely, and leave the collector as they found it."""

import gc

import pytest
from typer.testing import CliRunner

import smartview_jax.cli.main as main
from smartview_jax.cli import app
from smartview_jax.cli.main import OBJECTS_BETWEEN_COLLECTIONS, rare_collections


@pytest.fixture
def thresholds():
    """Sets the collector's thresholds, and puts them back after the test."""
    before = gc.get_threshold()
    yield lambda young: gc.set_threshold(young, 10, 10)
    gc.set_threshold(*before)


@pytest.mark.parametrize(("own", "within"), [(700, OBJECTS_BETWEEN_COLLECTIONS), (0, 0)])
def test_garbage_is_collected_rarely_and_only_within(thresholds, own, within):
    thresholds(own)
    with rare_collections():
        assert gc.get_threshold() == (within, 10, 10)
    assert gc.get_threshold() == (own, 10, 10)


def test_a_command_runs_with_rare_collections(thresholds, monkeypatch):
    thresholds(700)
    seen = []
    monkeypatch.setattr(main, "configure_logs", lambda _: lambda: seen.append(gc.get_threshold()))
    CliRunner().invoke(app, ["schema", "dataset"])
    assert seen == [(OBJECTS_BETWEEN_COLLECTIONS, 10, 10)]
    assert gc.get_threshold() == (700, 10, 10)
