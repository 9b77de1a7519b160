"""Programs are read without being traced, and only where they are the same programs."""

import os
import pickle
import subprocess
import sys

import jax
import numpy as np
import pytest

from smartview_jax import program_store
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.program_identity import constants, known_name, pickled_if_known, unpickled
from smartview_jax.program_store import ProgramStore

PROGRAM = """
import jax, numpy as np
import smartview_jax as sv
from smartview_jax.geometry import host_transforms
{before}
events = []
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: events.append(event))
camera = sv.Camera(500.0, 510.0, 320.0, 240.0, {lens}, (640, 480))
here = host_transforms(np.eye(4))
calibration = sv.Calibration(camera, here, here, "eye_in_hand")
pixels, _ = calibration.project(here, np.array([[0.1, 0.2, 2.0], [0.0, 0.0, 1.0]]))
ends = "program_read", "backend_compile_duration"
counts = [sum(event.endswith(end) for event in events) for end in ends]
print(*counts, *np.asarray(pixels).ravel())
"""

CAMERA = Camera(500.0, 510.0, 320.0, 240.0, Pinhole(), (640, 480))

PIXELS = [345.0, 291.0, 320.0, 240.0]


def output_of(folder, script):
    """What a process of a user of its own prints."""
    given = ("JAX", "XLA")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(given)}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment | {"XDG_CACHE_HOME": str(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def run(folder, before="", lens="sv.cameras.Radial(0.0)"):
    """Numbers of programs that such a process reads, and compiles, to project two points."""
    printed = output_of(folder, PROGRAM.format(before=before, lens=lens))
    read, compiled, *pixels = printed.split()
    np.testing.assert_allclose(np.array(pixels, float), PIXELS, rtol=1e-12)
    return int(read), int(compiled)


def test_a_second_process_compiles_nothing_that_the_first_kept(tmp_path):
    assert run(tmp_path) == (0, 1)
    assert run(tmp_path) == (1, 0)


def test_which_public_names_were_used_does_not_matter(tmp_path):
    run(tmp_path)
    (trace,) = (tmp_path / "smartview_jax").glob("*-trace")
    before = trace.stat().st_mtime_ns
    run(tmp_path, "sv.fit_joint, sv.calibrate, sv.held_out")
    assert trace.stat().st_mtime_ns == before, "it was traced again"


def test_a_process_with_other_constants_has_other_programs(tmp_path):
    changed = "import smartview_jax.cameras.radial as radial; radial._FOLD_STRENGTH *= 1.5"
    assert run(tmp_path) == (0, 1)
    assert run(tmp_path, changed) == (0, 1)
    assert run(tmp_path) == (1, 0), "the text is that of the first again"


def test_what_holds_a_class_of_the_user_is_traced_by_every_process(tmp_path):
    own = "class Mine(sv.cameras.Radial): pass"
    assert [run(tmp_path, own, "Mine(0.0)")[0] for _ in range(2)] == [0, 0]


@pytest.mark.parametrize("suffix", ["-trace", "-program"])
def test_a_broken_file_is_no_error(tmp_path, suffix):
    run(tmp_path)
    (file,) = (tmp_path / "smartview_jax").glob(f"*{suffix}")
    file.write_bytes(file.read_bytes()[:100])
    run(tmp_path)


class Calls:
    """Calls a function when it is read."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "content",
    [Calls(os.getcwd), Calls(eval, "1"), Calls(known_name, Camera), Calls(subprocess.Popen)],
)
def test_what_a_trace_would_call_is_not_called(content):
    with pytest.raises(Exception, match="is no class that is known"):
        unpickled(pickle.dumps(content))


@pytest.fixture
def store(tmp_path):
    """Makes the store of a function, where JAX is as it comes and compiles anew."""
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
        program, arrays = programs.find((np.ones(2), flag), {})
        result, same = program(arrays)
        np.testing.assert_array_equal(result, [factor, factor])
        assert same is flag


def test_arguments_without_effect_decide_too(store):
    def first_doubled(x, ignored):
        return 2.0 * x

    for size in (3, 4):
        program, arrays = store(first_doubled).find((np.ones(2), np.ones(size)), {})
        np.testing.assert_array_equal(program(arrays), [2.0, 2.0])


def test_of_a_function_of_the_user_nothing_is_kept(store):
    def mine(x):
        return x + 1.0

    assert store(mine, "__main__").find((np.ones(2),), {})[0] is None
    assert store(mine).find((np.ones(2),), {})[0] is not None


def test_with_other_settings_jax_is_asked_itself(store):
    def doubled(x):
        return 2.0 * x

    programs = store(doubled)
    for setting in (jax.debug_nans(True), jax.disable_jit(), jax.numpy_rank_promotion("raise")):
        with setting:
            assert programs.find((np.ones(2),), {})[0] is None
    assert programs.find((np.ones(2),), {})[0] is not None


def test_a_program_that_calls_python_stays_in_its_process(store, tmp_path):
    def called_back(x):
        return jax.pure_callback(
            lambda y: np.asarray(y) * 2.0, jax.ShapeDtypeStruct((2,), x.dtype), x
        )

    program, arrays = store(called_back).find((np.ones(2),), {})
    np.testing.assert_array_equal(program(arrays), [2.0, 2.0])
    assert not list(tmp_path.glob("*-trace")) + list(tmp_path.glob("*-program"))


LINEAR_ALGEBRA = """
import jax.numpy as jnp, numpy as np
from smartview_jax.compilation import compiled
def factor(x): return jnp.linalg.cholesky(x)
factor.__module__ = "smartview_jax.made_up"
print(*np.diag(compiled(factor)(np.diag([4.0, 9.0]))))
"""


def test_linear_algebra_is_there_for_a_program_that_is_read(tmp_path):
    """JAX finds LAPACK when it lowers a call of it, which the second process does not."""
    assert [output_of(tmp_path, LINEAR_ALGEBRA) for _ in range(2)] == ["2.0 3.0\n"] * 2
    assert len(list((tmp_path / "smartview_jax").glob("*-program"))) == 1


def test_equal_things_are_written_alike():
    words = "".join(["cam", "era"]), "".join(["cam", "era"])
    assert pickled_if_known(words) == pickled_if_known((words[0], words[0]))
    assert pickled_if_known(CAMERA) == pickled_if_known(pickle.loads(pickled_if_known(CAMERA)))
    assert pickled_if_known(store) is None
    assert known_name(Camera) == "smartview_jax.cameras.camera.Camera"


def test_a_changed_constant_or_function_changes_its_modules_checksum(monkeypatch):
    name, before = program_store.__name__, constants()
    monkeypatch.setattr(program_store, "TRACE_SUFFIX", "-other")
    assert {k for k, v in constants().items() if before[k] != v} == {name}
    monkeypatch.undo()
    assert constants() == before
    monkeypatch.setattr(program_store, "_read", lambda *_: None)
    assert constants()[name] != before[name]
