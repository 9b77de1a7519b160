"""Programs are read without being traced, and only where they are the same programs."""

import ast
import json
import os
import pickle
import subprocess
import sys
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from main_job import user_environment
from once_a_run import made_once

from smartview_jax.cameras import Camera, Pinhole, radial
from smartview_jax.runtime.compilation_cache import LAST_REMOVAL
from smartview_jax.runtime.program_store import ProgramStore
from smartview_jax.runtime.program_store import store as store_module
from smartview_jax.runtime.program_store.identity import (
    constants,
    known_name,
    pickled_if_known,
    sources,
)
from smartview_jax.runtime.program_store.safe_pickle import unpickled_program, unpickled_trace

PROCESS = """
import json
import jax, jax.numpy as jnp, numpy as np
import smartview_jax as sv
from smartview_jax.runtime.compilation import compiled
from smartview_jax.geometry import host_transforms
{before}
# The first call asks which compiler options there are.
compiled(lambda x: x)(np.zeros(1))
timed, hits = [], []
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: timed.append(event))
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))

def result_and_counts(function):
    timed.clear()
    hits.clear()
    result = np.asarray(function()).ravel().tolist()
    ends = "program_read", "backend_compile_duration"
    counts = [sum(event.endswith(end) for event in timed) for end in ends]
    return result, *counts, hits.count("/jax/compilation_cache/cache_hits")

def factor(x):
    return jnp.linalg.cholesky(x)

factor.__module__ = "smartview_jax.made_up"

class Mine(sv.cameras.Radial):
    pass

def projected(lens):
    camera = sv.Camera(500.0, 510.0, 320.0, 240.0, lens, (640, 480))
    here = host_transforms(np.eye(4))
    calibration = sv.Calibration(camera, here, here, "eye_in_hand")
    return calibration.project(here, np.array([[0.1, 0.2, 2.0], [0.0, 0.0, 1.0]]))[0]

print(json.dumps(dict(
    linear_algebra=result_and_counts(lambda: compiled(factor)(np.diag([4.0, 9.0]))),
    known=result_and_counts(lambda: projected(sv.cameras.Radial(0.0))),
    own=result_and_counts(lambda: projected(Mine(0.0))),
    script=result_and_counts(lambda: compiled(lambda x: x * 2.0 + 1.0)(np.arange(3.0))),
)))
"""

CAMERA = Camera(500.0, 510.0, 320.0, 240.0, Pinhole(), (640, 480))

RESULTS = {
    "linear_algebra": [2.0, 0.0, 0.0, 3.0],
    "known": [345.0, 291.0, 320.0, 240.0],
    "own": [345.0, 291.0, 320.0, 240.0],
    "script": [1.0, 3.0, 5.0],
}
"""What a process computes, whether it compiles its programs or reads them."""


def _two_processes(folder):
    """Run two processes like a user's; the second one uses more of the package's names."""
    folder.mkdir()
    found = []
    for before in ("", "sv.fit_joint, sv.calibrate, sv.held_out"):
        done = subprocess.run(
            [sys.executable, "-c", PROCESS.format(before=before)],
            env=user_environment(XDG_CACHE_HOME=str(folder)),
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        files = (folder / "smartview_jax").iterdir()
        times = {file.name: file.stat().st_mtime_ns for file in files}
        found.append([json.loads(done.stdout), done.stderr, times])
    (folder / "found.json").write_text(json.dumps(found))


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """Results of either process with numbers of programs read and compiled, stderr and files."""
    return json.loads(
        (made_once(tmp_path_factory, "two_processes", _two_processes) / "found.json").read_text()
    )


def test_every_source_of_the_package_decides_a_program():
    folders = {Path(path).name for path, *_ in ast.literal_eval(sources().decode())}
    assert {"radial.py", "fit.py", "store.py", "files.py"} <= folders


def test_programs_that_are_read_compute_what_the_compiled_ones_did(processes):
    """Linear algebra, too: JAX finds LAPACK when it lowers a call of it, which reading does not."""
    for said, _, _ in processes:
        for name, expected in RESULTS.items():
            np.testing.assert_allclose(said[name][0], expected, rtol=1e-12)


def test_a_second_process_compiles_nothing_that_the_first_kept(processes):
    for name in ("linear_algebra", "known"):
        counts = [said[name][1:3] for said, _, _ in processes]
        assert counts == [[0, 1], [1, 0]], name


def test_a_second_process_traces_nothing_again_whatever_names_were_used(processes):
    (_, _, before), (_, _, after) = processes
    traces = [name for name in before if name.endswith("-trace")]
    assert len(traces) == 2
    assert all(after[name] == before[name] for name in traces)


def test_what_holds_a_class_of_the_user_is_traced_by_every_process(processes):
    assert [said["own"][1] for said, _, _ in processes] == [0, 0]


def test_a_function_of_a_script_is_in_jaxs_own_cache(processes):
    """Though it takes a hundredth of a second to compile; and nothing is said of it."""
    assert [said["script"][3] for said, _, _ in processes] == [0, 1]
    _, stderr, files = processes[0]
    assert any(name.endswith("-cache") for name in files)
    assert not stderr


def test_without_this_room_jaxs_own_cache_is_used(tmp_path):
    """The room can be deleted: what it saves is time.

    A lens of the user's own has the program of the lens that it derives from, and is the second one
    to ask JAX for it.
    """
    is_deleted = "import sys; sys.modules['smartview_jax.runtime.program_store'] = None"
    done = subprocess.run(
        [sys.executable, "-c", is_deleted + PROCESS.format(before="")],
        env=user_environment(XDG_CACHE_HOME=str(tmp_path)),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    np.testing.assert_allclose(said["known"][0], RESULTS["known"], rtol=1e-12)
    np.testing.assert_allclose(said["own"][0], RESULTS["own"], rtol=1e-12)
    assert [said[name][3] for name in ("known", "own")] == [0, 1]
    names = {path.name for path in (tmp_path / "smartview_jax").iterdir()} - {LAST_REMOVAL}
    assert {name[-6:] for name in names} <= {"-cache", "-atime"}


class Calls:
    """Calls a function when it is read."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


CALLS = [
    Calls(os.getcwd),
    Calls(eval, "1"),
    Calls(known_name, Camera),
    Calls(subprocess.Popen),
    Calls(np.memmap, "planted", np.uint8, "w+", 0, (1,)),
    Calls(Path, "planted"),
]


@pytest.mark.parametrize("content", CALLS)
def test_what_a_file_would_call_is_not_called(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(pickle.UnpicklingError, match="may not be in a trace"):
        unpickled_trace(pickle.dumps(content))
    with pytest.raises(pickle.UnpicklingError, match="may not be in a program"):
        unpickled_program(pickle.dumps(content), 1, 1)
    assert not list(tmp_path.iterdir())


def test_of_getattr_only_members_of_enumerations_are_left():
    """So old versions of Python pickle such a member."""
    member = b"cbuiltins\ngetattr\n(cjax._src.core\nMemorySpace\nX\x04\x00\x00\x00HosttR."
    with pytest.raises((TypeError, ValueError, AttributeError)):
        # It is read, but no program.
        unpickled_program(member, 1, 1)
    attribute = b"cbuiltins\ngetattr\n(cjax._src.core\nShapedArray\nX\x08\x00\x00\x00__init__tR."
    with pytest.raises(pickle.UnpicklingError, match="its attributes may not be in a program"):
        unpickled_program(attribute, 1, 1)


@pytest.mark.parametrize("name", ["cameras.camera\nnp.memmap", "cameras.camera\neqx.Module"])
def test_what_a_module_imported_cannot_be_reached_through_it(name):
    with pytest.raises(pickle.UnpicklingError, match="may not be in a trace"):
        unpickled_trace(f"csmartview_jax.{name}\n.".encode())


def test_a_module_that_is_on_no_list_is_not_even_imported(tmp_path, monkeypatch):
    (tmp_path / "planted.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    for read in (unpickled_trace, lambda content: unpickled_program(content, 1, 1)):
        with pytest.raises(pickle.UnpicklingError, match="planted"):
            read(b"cplanted\nThing\n.")


@pytest.fixture
def store(tmp_path):
    """Makes the store of a function, with JAX's default settings, so that it compiles again."""
    settings = {
        "jax_compilation_cache_dir": str(tmp_path),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: jax.config.values[name] for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)

    def made(function, module="smartview_jax.made_up"):
        function.__module__, function.__qualname__ = module, function.__name__
        return ProgramStore(function, {})

    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield made
    for name, value in before.items():
        jax.config.update(name, value)


def test_arguments_that_are_equal_but_not_the_same_have_programs_of_their_own(store):
    def tripled(x, flag):
        return (x * 3.0, flag) if isinstance(flag, bool) else (x * 4.0, flag)

    programs = store(tripled)
    for flag, factor in ((True, 3.0), (1, 4.0), (True, 3.0)):
        program, arrays = programs.find(*jax.tree.flatten(((np.ones(2), flag), {})))
        result, same = program(arrays)
        np.testing.assert_array_equal(result, [factor, factor])
        assert same is flag


def test_a_python_number_and_an_array_share_a_program(store):
    """JAX's arrays of Python's numbers have weak types, which do not change double precision."""

    def halved(x):
        return 0.5 * x

    programs = store(halved)
    numbers = [jnp.asarray(3.0), jnp.asarray(np.float64(5.0)), np.float64(7.0)]
    assert [getattr(number, "weak_type", False) for number in numbers] == [True, False, False]
    found = [programs.find(*jax.tree.flatten(((number,), {}))) for number in numbers]
    assert len({id(program) for program, _ in found}) == 1
    assert [float(program(arrays)) for program, arrays in found] == [1.5, 2.5, 3.5]
    # Whole numbers keep theirs: a weak one may be added to a number of double precision.
    (weak, _), (strong, _) = (
        programs.find(*jax.tree.flatten(((number,), {})))
        for number in (jnp.asarray(3), jnp.asarray(np.int64(3)))
    )
    assert weak is not strong


def test_arguments_without_effect_decide_too(store):
    def first_doubled(x, ignored):
        return 2.0 * x

    for size in (3, 4):
        program, arrays = store(first_doubled).find(
            *jax.tree.flatten(((np.ones(2), np.ones(size)), {}))
        )
        np.testing.assert_array_equal(program(arrays), [2.0, 2.0])


def test_of_a_function_of_the_user_nothing_is_kept(store):
    def mine(x):
        return x + 1.0

    assert store(mine, "__main__").find(*jax.tree.flatten(((np.ones(2),), {})))[0] is None
    assert store(mine).find(*jax.tree.flatten(((np.ones(2),), {})))[0] is not None


def test_with_other_settings_jax_is_asked_itself(store):
    def doubled(x):
        return 2.0 * x

    programs = store(doubled)
    for setting in (jax.debug_nans(True), jax.disable_jit()):
        with setting:
            assert programs.find(*jax.tree.flatten(((np.ones(2),), {})))[0] is None
    assert programs.find(*jax.tree.flatten(((np.ones(2),), {})))[0] is not None


def test_a_program_is_of_the_strictness_that_it_was_traced_with(store):
    """A rank that is promoted is refused, although a kept program promotes it."""

    def added(x, y):
        return x + y

    arguments = np.ones((2, 2)), np.ones(2)
    for programs in (store(added), store(added)):
        program, arrays = programs.find(*jax.tree.flatten((arguments, {})))
        np.testing.assert_array_equal(program(arrays), np.full((2, 2), 2.0))
        with jax.numpy_rank_promotion("raise"), pytest.raises(ValueError, match="rank_promotion"):
            programs.find(*jax.tree.flatten((arguments, {})))
        with jax.numpy_rank_promotion("raise"):
            program, arrays = programs.find(*jax.tree.flatten(((np.ones(2), np.ones(2)), {})))
        np.testing.assert_array_equal(program(arrays), [2.0, 2.0])


def test_a_program_that_calls_python_stays_in_its_process(store, tmp_path):
    # Without arguments: a callback that waits for its arguments can wait for itself.
    def called_back(x):
        return x + jax.pure_callback(lambda: np.ones(2), jax.ShapeDtypeStruct((2,), x.dtype))

    program, arrays = store(called_back).find(*jax.tree.flatten(((np.ones(2),), {})))
    np.testing.assert_array_equal(program(arrays), [2.0, 2.0])
    assert not list(tmp_path.glob("*-trace")) + list(tmp_path.glob("*-program"))


def test_a_process_with_other_constants_has_other_programs(store, tmp_path, monkeypatch):
    def folded(x):
        return radial._FOLD_STRENGTH * x

    def found():
        program, arrays = store(folded).find(*jax.tree.flatten(((np.ones(1),), {})))
        return program(arrays)[0]

    as_it_is = radial._FOLD_STRENGTH
    assert found() == as_it_is
    monkeypatch.setattr(radial, "_FOLD_STRENGTH", 1.5 * as_it_is)
    assert found() == 1.5 * as_it_is
    monkeypatch.setattr(radial, "_FOLD_STRENGTH", as_it_is)
    assert found() == as_it_is
    assert len(list(tmp_path.glob("*-program"))) == 2, "the text is the first program's again"


@pytest.mark.parametrize("suffix", ["-trace", "-program"])
def test_a_broken_file_is_no_error(store, tmp_path, suffix):
    def doubled(x):
        return 2.0 * x

    for _ in range(3):
        program, arrays = store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))
        np.testing.assert_array_equal(program(arrays), [2.0, 2.0])
        (file,) = tmp_path.glob(f"*{suffix}")
        file.write_bytes(file.read_bytes()[:100])


def test_a_planted_program_is_not_run(store, tmp_path):
    """A trace knows its program's digest, and without a trace the list of classes stands."""

    def doubled(x):
        return 2.0 * x

    store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))
    (program,) = tmp_path.glob("*-program")
    for without_trace in (False, True):
        planted = Calls(os.mkdir, str(tmp_path / "planted"))
        program.write_bytes(zlib.compress(pickle.dumps(planted)))
        if without_trace:
            next(tmp_path.glob("*-trace")).unlink()
        run, arrays = store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))
        np.testing.assert_array_equal(run(arrays), [2.0, 2.0])
        assert not (tmp_path / "planted").exists()


def test_another_functions_program_is_not_taken_for_its_own(store, tmp_path):
    def doubled(x):
        return 2.0 * x

    def tripled(x):
        return 3.0 * x

    for function in (doubled, tripled):
        store(function).find(*jax.tree.flatten(((np.ones(2),), {})))
    (program,) = tmp_path.glob("doubled*-program")
    (other,) = tmp_path.glob("tripled*-program")
    program.write_bytes(other.read_bytes())
    (before,) = (path.read_bytes() for path in tmp_path.glob("doubled*-trace"))
    assert store_module._read(next(tmp_path.glob("doubled*-trace")), 1) is None
    assert before


@pytest.mark.parametrize("mode", [0o722, 0o777])
def test_in_a_folder_that_others_can_write_nothing_is_kept_or_read(store, tmp_path, mode):
    def doubled(x):
        return 2.0 * x

    assert store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))[0] is not None
    tmp_path.chmod(mode)
    assert store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))[0] is None


@pytest.mark.parametrize("suffix", ["-trace", "-program"])
def test_a_file_that_others_can_write_is_not_read(store, tmp_path, suffix):
    def doubled(x):
        return 2.0 * x

    store(doubled).find(*jax.tree.flatten(((np.ones(2),), {})))
    (file,) = tmp_path.glob(f"*{suffix}")
    assert store_module._content(file) is not None
    file.chmod(0o666)
    assert store_module._content(file) is None


def test_equal_things_are_written_alike():
    words = "".join(["cam", "era"]), "".join(["cam", "era"])
    assert pickled_if_known(words) == pickled_if_known((words[0], words[0]))
    assert pickled_if_known(CAMERA) == pickled_if_known(pickle.loads(pickled_if_known(CAMERA)))
    assert pickled_if_known(store) is None
    assert known_name(Camera) == "smartview_jax.cameras.camera.Camera"


def test_a_changed_constant_or_function_changes_its_modules_checksum(monkeypatch):
    name, before = store_module.__name__, constants()
    monkeypatch.setattr(store_module, "TRACE_SUFFIX", "-other")
    assert {k for k, v in constants().items() if before[k] != v} == {name}
    monkeypatch.undo()
    assert constants() == before
    monkeypatch.setattr(store_module, "_read", lambda *_: None)
    assert constants()[name] != before[name]
