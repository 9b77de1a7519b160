import signal
import subprocess
import sys
import threading
import time

import pytest
from board_scene import board_folder

from smartview_jax.runtime.interrupts import (
    INTERRUPT_MESSAGE,
    interrupt_listener,
    print_message_once,
)

ANSWER = 2.0
"""Promised, s; a machine that does other things besides is given as much again and more."""

STUCK = """
import hashlib, sys
from smartview_jax.runtime.interrupts import interrupt_listener
from smartview_jax.files import file_transaction

with interrupt_listener(), file_transaction(sys.argv[1], ["result.yaml"]) as folder:
    (folder / "result.yaml").write_text("half")
    print("begun", file=sys.stderr, flush=True)
    # One call into a library, which Python cannot interrupt, for about a minute.
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**8)
"""

CALIBRATE = "from smartview_jax.cli import app; app()"

HEARS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
"""A shell starts what runs in its background deaf to interrupts, and so all that this starts."""


def interrupted(code, arguments, word, wait=0.0):
    """Exit code, time to it, and stderr of a program interrupted after it said a word."""
    command = [sys.executable, "-c", HEARS + code, *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as program:
        said = b""
        try:
            while word not in said:
                line = program.stderr.readline()
                assert line, said.decode()
                said += line
            time.sleep(wait)
            started = time.monotonic()
            program.send_signal(signal.SIGINT)
            said += program.stderr.read()
            return program.wait(60.0), time.monotonic() - started, said.decode()
        finally:
            program.kill()


def test_a_library_that_does_not_listen_is_left(tmp_path):
    (tmp_path / "result.yaml").write_text("of the last run")
    # The word comes a moment before the library is called.
    code, took, said = interrupted(STUCK, [str(tmp_path)], b"begun", wait=0.5)
    assert code == 130
    assert took < 2.0 * ANSWER
    assert said.count("interrupted; no file is left half-written") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["result.yaml"]
    assert (tmp_path / "result.yaml").read_text() == "of the last run"


IN_A_DESTRUCTOR = """
import signal, sys, time
from smartview_jax.runtime.interrupts import interrupt_listener

class Slow:
    def __del__(self):
        print("begun", file=sys.stderr, flush=True)
        time.sleep(20.0)

with interrupt_listener():
    slow = Slow()
    del slow
    time.sleep(20.0)
"""


def test_an_interrupt_that_python_drops_leaves_no_traceback():
    """It arrives while an object is destroyed: the main thread goes on, the second one ends all."""
    code, took, said = interrupted(IN_A_DESTRUCTOR, [], b"begun")
    assert code == 130
    assert took < 2.0 * ANSWER
    assert "Traceback" not in said
    assert said.count("interrupted; no file is left half-written") == 1


@pytest.mark.parametrize(("word", "wait"), [(b"view 0 ", 0.0), (b"Step 1", 0.3)])
def test_a_calibration_ends_with_a_line_of_words(tmp_path_factory, tmp_path, word, wait):
    """While circles of the sample are looked for, and while programs are compiled."""
    data = [] if wait == 0.0 else [str(board_folder(tmp_path_factory))]
    out = tmp_path / "out"
    code, took, said = interrupted(CALIBRATE, ["calibrate", *data, "--out", str(out)], word, wait)
    assert code == 130, said
    assert took < 2.0 * ANSWER
    assert said.count("interrupted; no file is left half-written") == 1
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_the_words_are_out_before_another_thread_may_end_the_process():
    printed = []

    def write_slowly(text):
        time.sleep(0.2)
        printed.append(text)

    with interrupt_listener():
        thread = threading.Thread(target=print_message_once, args=(write_slowly,))
        thread.start()
        time.sleep(0.05)
        print_message_once(printed.append)
        assert printed == [INTERRUPT_MESSAGE]
        thread.join()
    assert printed == [INTERRUPT_MESSAGE]
