"""What `.ci/run` repeats after a change: a check's sources are found through its imports."""

import importlib.util
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / ".ci" / "sources.py"


@pytest.fixture(scope="module")
def ci_sources():
    spec = importlib.util.spec_from_file_location("ci_sources", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def sources_of(ci_sources):
    checks = ci_sources.checks()

    def names(check):
        return {str(f.relative_to(ci_sources.ROOT)) for f in ci_sources.sources(checks[check])}

    return names


def test_sources_are_found_through_imports(sources_of):
    tuning = sources_of("notebooks/tuning")
    assert {"notebooks/tuning.ipynb", "smartview_jax/engine/schur.py"} <= tuning
    assert ".ci/constraints.txt" in tuning
    # A fit needs neither a person's page nor the search for objects.
    assert not any("/editor/" in name or "/localization/" in name for name in tuning)
    assert "smartview_jax/localization/judging/verdict.py" in sources_of("benchmarks/hypotheses")


def test_data_of_a_package_are_sources(sources_of):
    assert "smartview_jax/editor/page/editor.js" in sources_of("notebooks/find_and_grasp")


def test_what_git_ignores_is_no_source(ci_sources, sources_of, tmp_path, monkeypatch):
    """Found circles are kept next to the sample's pictures: a fresh clone has none."""
    assert "smartview_jax/samples/rct_circle10x10/poses.csv" in sources_of("demo")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / ".gitignore").write_text("found.csv\n")
    for name in ("poses.csv", "found.csv"):
        (tmp_path / name).touch()
    monkeypatch.setattr(ci_sources, "ROOT", tmp_path)
    names = {file.name for file in ci_sources.kept_files.__wrapped__()}
    assert names == {".gitignore", "poses.csv"}


def test_what_starts_processes_depends_on_the_whole_package(sources_of):
    assert {"smartview_jax/cli/main.py", "smartview_jax/grasping/planning.py"} <= sources_of(
        "benchmarks/startup"
    )


def test_a_changed_file_changes_the_digest(ci_sources, tmp_path, monkeypatch):
    monkeypatch.setattr(ci_sources, "ROOT", tmp_path)
    monkeypatch.setattr(ci_sources, "sources", lambda starts: starts)
    file = tmp_path / "a.py"
    file.write_text("x = 1\n")
    before = ci_sources.digest([file])
    assert ci_sources.digest([file]) == before
    file.write_text("x = 2\n")
    assert ci_sources.digest([file]) != before
