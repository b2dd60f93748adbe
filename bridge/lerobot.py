"""``python -m bridge export``: turn a recording into a LeRobotDataset v3.0, in Parquet and MP4.

A frame is a state with the first answer to it; a state without an answer is left out, and the
feature ``step`` jumps. The file is read once for each array, so that pictures need no memory.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bridge.messages import images_of, is_picture
from bridge.ports import add_options
from bridge.replay import RecordedDrive, key_of
from edge_runtime.cli import ArgumentParser, examples, sigterm_as_interrupt
from edge_runtime.config import NONE
from edge_runtime.files import check_writable, draft_of, write_json
from edge_runtime.manifest import Layout, Task
from edge_runtime.util import UserError, counted
from edge_runtime.wire import Command, State, is_foreign

try:
    import av
    import pyarrow as pa
    from pyarrow.parquet import write_table
except ImportError:
    raise UserError(
        "export and films need av and pyarrow: pip install 'phil-hil[lerobot]'"
    ) from None

EXAMPLE = examples("python -m bridge export drive.mcap --format lerobot --out datasets/drive")
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
FIRST = FILE.format(chunk_index=0, file_index=0)
SAMPLED_PIXELS = 256  # Of each picture, for the statistics
ENCODER = {"crf": "10", "g": "2", "bf": "0"}
"""Nearly lossless; every second picture is a key frame, because a training seeks at random."""
QUANTILES = (1, 10, 50, 90, 99)
Columns = dict[str, Any]  # Feature to [frames, ...]; of a video, a sample of its pixels


def add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    form = "format of the data set: LeRobotDataset v3.0"
    out = "the directory of the data set, which must not exist yet"
    add("recording", metavar="F.mcap", help="a file of bridge record")
    add("--format", choices=["lerobot"], required=True, help=form)
    add("--out", metavar="DIR", required=True, help=out)
    several = "the vehicle, if the recording holds several"
    add_options(parser, "--vehicle-id", default=None, help=several)


def run(arguments: Any) -> int:
    """Run the command. The directory gets its name when it is whole; otherwise nothing is left."""
    out = Path(arguments.out)
    if os.path.lexists(out):
        raise UserError(f"{out} exists; choose another name: no data set is lost")
    check_writable(out)
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    with sigterm_as_interrupt(), draft_of(out) as draft:
        frames = _export(drive, draft)
    print(f"wrote {out}: {counted(frames, 'frame')}")
    return 0


def _export(drive: RecordedDrive, folder: Path) -> int:
    """Write the data set and return its number of frames; UserError where no state was answered."""
    task = drive.task
    if task is None:
        raise UserError(f"{drive.recording.path} holds no scene that says how to read the states")
    for name in task.observation:
        if not re.fullmatch(r"[\w -]{1,64}", name):  # It becomes part of a path.
            raise UserError(f"the observation {name!r} cannot be the name of a feature")
    folder.mkdir(parents=True)
    rate = Fraction(1 / task.control_period_s).limit_denominator(1000)
    columns, bounds = _numbers(drive, task, rate)
    features = {key: _feature(values) for key, values in columns.items()}
    features["action"]["names"] = [row.name for row in task.action]
    plain = [name for name, entry in task.observation.items() if not is_picture(entry)]
    for name in task.observation:
        arrays = (layout.arrays(s.observation)[name] for layout, s, _ in _kept(drive, task))
        if name in plain:
            key = "observation.state" if len(plain) == 1 else f"observation.{name}"
            columns[key] = np.array([array.ravel() for array in arrays])
            features[key] = _feature(columns[key])
        else:
            key = f"observation.images.{name}"
            path = folder / f"videos/{key}/{FIRST}.mp4"
            columns[key], features[key] = _encode(path, rate, arrays)
    _write_tables(folder, task.task, rate, columns, features, bounds)
    episodes = len(bounds) - 1
    info = {
        "codebase_version": "v3.0", "fps": int(rate) if rate.denominator == 1 else float(rate),
        "robot_type": None if drive.vehicle == NONE else drive.vehicle,
        "total_episodes": episodes, "total_tasks": 1, "splits": {"train": f"0:{episodes}"},
        "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
        "data_path": f"data/{FILE}.parquet", "video_path": f"videos/{{video_key}}/{FILE}.mp4",
        "total_frames": bounds[-1], "features": features,
    }  # fmt: skip
    write_json(folder / "meta/info.json", info)
    write_json(folder / "meta/stats.json", _stats(columns, features, slice(0, bounds[-1])))
    return bounds[-1]


def _kept(drive: RecordedDrive, task: Task) -> Iterator[tuple[Layout, State, Command]]:
    layout = Layout(task)
    for state in drive.states():
        exchange = None if state.final else drive.answers.get(key_of(state))
        readable = not (layout.refusal(state.observation) or is_foreign(state, task.text))
        if readable and exchange and len(exchange.command.action) == len(task.action):
            yield layout, state, exchange.command


def _numbers(drive: RecordedDrive, task: Task, rate: Fraction) -> tuple[Columns, list[int]]:
    """Return the columns of every data set, and the bounds of its episodes in frames."""
    kept = [answer for _, _, answer in _kept(drive, task)]
    if not kept:
        raise UserError(f"{drive.recording.path} holds no answered state of {task.text}")
    ended = {key_of(state)[:2] for state in drive.states() if state.final}
    episodes = [key_of(answer)[:2] for answer in kept]
    bounds = [at for at, name in enumerate(episodes) if not at or name != episodes[at - 1]]
    bounds.append(len(kept))
    index, lengths = np.arange(len(kept)), np.diff(bounds)
    number = index - np.repeat(bounds[:-1], lengths)
    columns = {
        "action": np.array([answer.action for answer in kept], np.float32),
        "mode": np.array([answer.mode for answer in kept]),
        "step": np.array([answer.step for answer in kept], np.uint64).astype(np.int64),
        "next.done": np.isin(index + 1, bounds) & [name in ended for name in episodes],
        "timestamp": (number / float(rate)).astype(np.float32),
        "frame_index": number,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": index,
        "task_index": np.zeros_like(index),
    }
    return columns, bounds


def _feature(values: Any) -> dict[str, Any]:
    dtype = "string" if values.dtype.kind == "U" else values.dtype.name
    return {"dtype": dtype, "shape": [math.prod(values.shape[1:])], "names": None}


def _encode(
    path: Path, rate: Fraction, arrays: Iterable[np.ndarray]
) -> tuple[np.ndarray, dict[str, Any]]:
    """Encode the newest picture of each array; return a sample of pixels, and the feature."""
    path.parent.mkdir(parents=True)
    sampled = []
    with film(path, rate, ENCODER) as add:
        for array in arrays:
            images = images_of(array)
            height, width = images.shape[1:3]
            picture = np.ascontiguousarray(np.broadcast_to(images[-1], (height, width, 3)))
            add(picture)
            pixels = picture.reshape(-1, 3)[:: height * width // SAMPLED_PIXELS + 1]
            sampled.append(pixels.copy())  # A view would keep the picture.
    info = {
        "video.height": height, "video.width": width, "video.codec": "h264",
        "video.pix_fmt": _pixel_format(picture), "video.fps": int(rate),
        "video.channels": 3, "has_audio": False, "is_depth_map": False,
    }  # fmt: skip
    feature = {"dtype": "video", "shape": [height, width, 3], "info": info}
    return np.array(sampled), feature | {"names": ["height", "width", "channels"]}


@contextmanager
def film(
    path: Path, rate: Fraction, options: dict[str, str] | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """Write an MP4 of ``rate`` pictures a second; yield ``add(uint8 [height, width, 3])``."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=rate, options=options)
        numbers = count()

        def add(picture: np.ndarray) -> None:
            if not (number := next(numbers)):
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = _pixel_format(picture)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))


def _pixel_format(picture: np.ndarray) -> str:
    """Return the format with halved colours, which players expect and which needs even sizes."""
    return "yuv444p" if np.any(np.mod(picture.shape[:2], 2)) else "yuv420p"


def _write_tables(
    folder: Path, task: str, rate: Fraction, columns: Columns, features: Any, bounds: list[int]
) -> None:
    import pandas as pd  # Slow to load, and not needed for --help

    episodes = []
    places = [f"videos/{key}" for key in features if features[key]["dtype"] == "video"]
    for number, (start, end) in enumerate(pairwise(bounds)):
        row = {"episode_index": number, "tasks": [task], "length": end - start}
        row |= {"dataset_from_index": start, "dataset_to_index": end}
        for place in ("data", "meta/episodes", *places):
            row |= {f"{place}/chunk_index": 0, f"{place}/file_index": 0}
        for place in places:
            row |= {f"{place}/from_timestamp": float(start / rate)}
            row |= {f"{place}/to_timestamp": float(end / rate)}
        for key, stats in _stats(columns, features, slice(start, end)).items():
            row |= {f"stats/{key}/{name}": value for name, value in stats.items()}
        episodes.append(row)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([task], name="task"))
    numbers = {key: column for key, column in columns.items() if column.ndim < 3}
    for name, table in {
        f"data/{FIRST}": pa.table({key: _column(column) for key, column in numbers.items()}),
        f"meta/episodes/{FIRST}": pa.Table.from_pylist(episodes),
        "meta/tasks": pa.Table.from_pandas(tasks),
    }.items():
        path = folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table(table, path)


def _column(values: np.ndarray) -> Any:
    column, size = pa.array(values.ravel()), values.size // len(values)
    return column if size == 1 else pa.FixedSizeListArray.from_arrays(column, size)


def _stats(columns: Columns, features: dict[str, Any], frames: slice) -> dict[str, Any]:
    """Return LeRobot's statistics of each feature except texts; of a video by colour, 0 to 1."""
    all_stats = {}
    for key, feature in features.items():
        if feature["dtype"] == "string":
            continue
        # As float64, so that the squares of any float32 are finite
        values, shape = columns[key][frames].astype(np.float64), feature["shape"]
        if feature["dtype"] == "video":
            values, shape = values.reshape(-1, 3) / 255, [3, 1, 1]
        stats = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
        stats |= {f"q{part:02d}": np.percentile(values, part, axis=0) for part in QUANTILES}
        all_stats[key] = {name: np.reshape(value, shape).tolist() for name, value in stats.items()}
        all_stats[key]["count"] = [frames.stop - frames.start]
    return all_stats
