"""Read a data set of LeRobot: the robot's states, and the pictures of its cameras.

    meta/info.json        version, frames per second, and the features: pictures, states, actions
    data/**/*.parquet     a row for each frame: episode, time, states
    videos/**/*.mp4       pictures, by camera; or they are in the rows
    meta/episodes/**      from version 3 on, where in the videos each episode begins

Versions 2.0, 2.1 and 3.0. Reference: LeRobot, https://github.com/huggingface/lerobot.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from ..extras import import_extra
from ..files import parse_json, read_text
from .moments import NANOSECONDS

INFO_FILE = Path("meta", "info.json")
"""The file that describes a data set."""

VERSIONS = ("v2.0", "v2.1", "v3.0")
"""Versions of the format that are read."""

EPISODE_GAP = 60.0
"""Time that is put between two episodes, s: each has a clock of its own, which begins at zero."""

LAST_FRAME_EARLY = 0.05
"""Largest time by which the last frame of a video may be before its stamp, s: less than two frames
at usual rates."""

_EXTRA = "lerobot"


class Frames(NamedTuple):
    """The frames of all episodes that are used, in the order of time.

    Attributes:
        stamps: times, ns; episodes follow each other with `EPISODE_GAP` between them.
        episodes: number of each frame's episode.
        numbers: number of each frame in its episode.
        times: times in the episode, s.
        states: the feature's numbers.
    """

    stamps: Int64[np.ndarray, "frames"]
    episodes: Int64[np.ndarray, "frames"]
    numbers: Int64[np.ndarray, "frames"]
    times: Float[np.ndarray, "frames"]
    states: Float[np.ndarray, "frames numbers"]


class LeRobotDataset:
    """A folder of LeRobot, with the description of each feature by its name."""

    def __init__(self, path: Path):
        """Read the description.

        Raises:
            FileNotFoundError: the folder has no `meta/info.json`.
            ValueError: the description is not of a known version.
        """
        self.path = path
        file = path / INFO_FILE
        if not file.is_file():
            raise FileNotFoundError(f"{path}: no data set of LeRobot: {INFO_FILE} is missing")
        info = parse_json(read_text(file), file)
        version = info.get("codebase_version") if isinstance(info, dict) else None
        if version not in VERSIONS:
            raise ValueError(
                f"{file}: codebase_version: expected {', '.join(VERSIONS)}, found {version!r}"
            )
        self.features: dict[str, Mapping[str, Any]] = info.get("features") or {}
        if not all(isinstance(feature, dict) for feature in self.features.values()):
            raise ValueError(f"{file}: features: expected a mapping for each")
        # Data sets without videos have no path of them.
        self._video_template = str(info.get("video_path") or "")
        self._chunk_size = info.get("chunks_size") or 1000
        if not isinstance(self._chunk_size, int):
            raise ValueError(f"{file}: chunks_size: expected a number, found {self._chunk_size!r}")
        self._in_shared_files = version == "v3.0"

    def image_feature(self, name: str | None) -> str:
        """Return the feature of the pictures: the named one, or the only one."""
        known = [key for key, f in self.features.items() if f.get("dtype") in ("video", "image")]
        if name in known:
            return str(name)
        if name is None and len(known) == 1:
            return known[0]
        wanted = "one feature of pictures" if name is None else f"pictures {name!r}"
        several = "; name one of them, or each of them for a rig" if name is None and known else ""
        raise ValueError(
            f"{self.path / INFO_FILE}: expected {wanted}, found {', '.join(known) or 'none'}"
            f"{several}"
        )

    def names(self, feature: str) -> tuple[str, ...]:
        """Return the names of a feature's numbers; empty where the description has none."""
        described = self.features.get(feature, {})
        if not str(described.get("dtype", "")).startswith(("float", "int")):
            numeric = [k for k, f in self.features.items() if str(f.get("dtype"))[:3] == "flo"]
            raise ValueError(
                f"{self.path / INFO_FILE}: expected a feature of numbers called {feature!r}, found "
                f"{', '.join(numeric) or 'none'}"
            )
        names = described.get("names")
        # Some data sets put all names under a heading, such as "motors".
        if isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        shape = described.get("shape") or [0]
        if not isinstance(names, list | dict) or len(names) != shape[0]:
            return ()
        return tuple(map(str, names))

    def frames(self, feature: str, episodes: Sequence[int] = ()) -> Frames:
        """Return the frames of some episodes, or of all, with the numbers of a feature."""
        columns = ["episode_index", "frame_index", "timestamp", feature]
        tables = [self._columns(file, columns) for file in self._files("data", "frames")]
        table = {key: np.concatenate([t[key] for t in tables]) for key in columns}
        all_episodes = table["episode_index"].astype(np.int64)
        if missing := sorted(set(episodes) - set(all_episodes.tolist())):
            raise ValueError(
                f"{self.path}: no episode {missing[0]}; there are {len(np.unique(all_episodes))}, "
                "from 0"
            )
        used = np.isin(all_episodes, list(episodes) or all_episodes)
        order = np.lexsort((table["frame_index"][used], all_episodes[used]))
        episode, number, time, states = (table[key][used][order] for key in columns)
        time = time.astype(float)
        if not np.isfinite(time).all():
            raise ValueError(f"{self.path}: timestamp: expected numbers, found NaN")
        begins, stamps = 0.0, np.zeros(len(time), dtype=np.int64)
        for each in np.unique(episode):
            in_episode = episode == each
            stamps[in_episode] = np.round(NANOSECONDS * (begins + time[in_episode])).astype(
                np.int64
            )
            begins += float(time[in_episode].max()) + EPISODE_GAP
        return Frames(
            stamps, episode.astype(np.int64), number.astype(np.int64), time, states.astype(float)
        )

    def pictures(
        self,
        feature: str,
        frames: Frames,
        chosen: Sequence[int],
        progress: Callable[[str], None] | None = None,
    ) -> Iterator[tuple[int, np.ndarray | bytes]]:
        """Yield the pictures of some frames: their place in `frames`, and the picture.

        Pictures of a video are arrays (BGR); others are the bytes of their files.
        """
        report = progress or (lambda _: None)
        if self.features[feature].get("dtype") == "image":
            yield from self._pictures_in_rows(feature, frames, chosen)
            return
        wanted: dict[Path, list[tuple[float, int]]] = {}
        begins = self._video_places(feature) if self._in_shared_files else {}
        for k in chosen:
            episode = int(frames.episodes[k])
            path, begin = begins[episode] if begins else (self._video_of(feature, episode), 0.0)
            wanted.setdefault(path, []).append((begin + float(frames.times[k]), k))
        for path, places in wanted.items():
            report(f"reading {path.name}")
            yield from _frames_of_video(path, sorted(places))

    def _video_of(self, feature: str, episode: int) -> Path:
        """Return the video of an episode, of version 2."""
        chunk = episode // self._chunk_size
        return self._video_file(episode_chunk=chunk, video_key=feature, episode_index=episode)

    def _video_places(self, feature: str) -> dict[int, tuple[Path, float]]:
        """Return the video of each episode and where in it the episode begins, s; of version 3."""
        prefix = f"videos/{feature}"
        keys = [f"{prefix}/{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
        places = {}
        for file in self._files("meta/episodes", "episodes"):
            table = self._columns(file, ["episode_index", *keys])
            for episode, chunk, number, begin in zip(*table.values(), strict=True):
                path = self._video_file(
                    video_key=feature, chunk_index=int(chunk), file_index=int(number)
                )
                places[int(episode)] = (path, float(begin))
        return places

    def _video_file(self, **parts: str | int) -> Path:
        """Return the file of a video by the description's pattern."""
        try:
            return self.path / self._video_template.format(**parts)
        except (KeyError, IndexError, ValueError, AttributeError):
            raise ValueError(
                f"{self.path / INFO_FILE}: video_path: expected a pattern of {', '.join(parts)}, "
                f"found {self._video_template!r}"
            ) from None

    def _pictures_in_rows(
        self, feature: str, frames: Frames, chosen: Sequence[int]
    ) -> Iterator[tuple[int, bytes]]:
        """Yield the pictures that are in the tables of the frames."""
        places = {(int(frames.episodes[k]), int(frames.numbers[k])): k for k in chosen}
        for file in self._files("data", "frames"):
            numbers = self._columns(file, ["episode_index", "frame_index"])
            frames_here = list(zip(*(column.tolist() for column in numbers.values()), strict=True))
            rows = [row for row, frame in enumerate(frames_here) if frame in places]
            # Pictures are large: only the wanted ones are unpacked.
            pictures = self._columns(file, [feature], rows)[feature] if rows else []
            for row, picture in zip(rows, pictures, strict=True):
                episode, number = frames_here[row]
                content = picture.get("bytes") if isinstance(picture, dict) else None
                if not content:
                    raise ValueError(
                        f"{file}: {feature}: expected a picture, found none in frame {number} of "
                        f"episode {episode}"
                    )
                yield places[episode, number], content

    def _files(self, folder: str, meaning: str) -> list[Path]:
        files = sorted((self.path / folder).rglob("*.parquet"))
        if not files:
            raise FileNotFoundError(f"{self.path / folder}: no tables (.parquet) of the {meaning}")
        return files

    def _columns(
        self, file: Path, names: Sequence[str], rows: Sequence[int] | None = None
    ) -> dict[str, np.ndarray]:
        """Return columns of a table, or some rows of them; lists of numbers as rows of a matrix."""
        parquet = import_extra("pyarrow.parquet", _EXTRA, "a data set of LeRobot")
        arrow = import_extra("pyarrow", _EXTRA, "a data set of LeRobot")
        try:
            present = parquet.read_schema(file).names
            if absent := [name for name in names if name not in present]:
                raise ValueError(
                    f"{file}: expected a column {absent[0]}, found {', '.join(present)}"
                )
            table = parquet.read_table(file, columns=list(names))
            table = table if rows is None else table.take(rows)
        except arrow.ArrowException as error:
            raise ValueError(f"{file}: no readable table: {error}") from error
        columns = {}
        for name in names:
            values = table.column(name).to_pylist()
            is_list = bool(values) and isinstance(values[0], list)
            lengths = {len(row) for row in values} if is_list else set()
            if len(lengths) > 1:
                raise ValueError(f"{file}: {name}: rows of {sorted(lengths)} numbers")
            is_object = bool(values) and isinstance(values[0], dict)
            columns[name] = np.array(values, dtype=object if is_object else None)
        return columns


def _frames_of_video(
    path: Path, places: Sequence[tuple[float, int]]
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the frames of a video next to some times (s, increasing), with what belongs to each."""
    av = import_extra("av", _EXTRA, "a video of LeRobot")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video")
    waiting = list(places)
    try:
        with av.open(str(path)) as container:
            before: tuple[float, Any] | None = None
            for frame in container.decode(video=0):
                now = float(frame.time)
                # The nearest frame is known once a frame at or after the time was seen.
                while waiting and now >= waiting[0][0]:
                    time, place = waiting.pop(0)
                    nearer = before is not None and time - before[0] < now - time
                    best = before[1] if nearer and before is not None else frame
                    yield place, best.to_ndarray(format="bgr24")
                if not waiting:
                    return
                before = (now, frame)
            # Stamps are rounded: the last frame may be a little before its time.
            if (
                before is not None
                and len(waiting) == 1
                and waiting[0][0] - before[0] < LAST_FRAME_EARLY
            ):
                yield waiting.pop()[1], before[1].to_ndarray(format="bgr24")
    except av.FFmpegError as error:
        raise ValueError(f"{path}: no readable video: {error}") from error
    if waiting:
        raise ValueError(f"{path}: the video ends before {waiting[0][0]:.3f} s")
