"""What tests of several files need and takes seconds: made once in a run, for all workers."""

import fcntl
import os
import pickle
import shutil


def made_once(tmp_path_factory, name, make):
    """The folder that a function makes when the first test asks for it; it is only to be read.

    Args:
        tmp_path_factory: pytest's fixture, whose folder is of this run alone.
        name: of the folder.
        make: called with the folder's path.
    """
    root = tmp_path_factory.getbasetemp()
    # A worker has a folder of its own in the folder of the run.
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder, finished = root / name, root / f"{name}.finished"
    with open(root / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not finished.exists():
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
            finished.touch()
    return folder


def computed_once(tmp_path_factory, name, compute):
    """What a function returns when the first test asks for it; the others read it.

    Args:
        tmp_path_factory: pytest's fixture, whose folder is of this run alone.
        name: of the result.
        compute: called without arguments.
    """

    def make(folder):
        folder.mkdir()
        (folder / "result.pickle").write_bytes(pickle.dumps(compute()))

    folder = made_once(tmp_path_factory, name, make)
    return pickle.loads((folder / "result.pickle").read_bytes())
