"""Small valid files of every kind that the library reads, and all of their content as the library
reads it.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers.h5_files import write_file
from helpers.videos import video_bytes
from mme_vla.data.cache import fingerprint
from mme_vla.data.cache_building import build_cache
from mme_vla.data.convert import convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.evaluation.records import EpisodeRecord, RecordLog, Seconds
from mme_vla.evaluation.store import RECORDS, begin_run
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.finetuning.rows import RowDataset
from mme_vla.subgoal.models.api import Api, Settings
from mme_vla.subgoal.models.replies import Reply
from mme_vla.utils import write_sums
from mme_vla.utils.media import png_bytes


def digest(*values: object) -> str:
    """A hash of arrays and of whatever has a faithful `repr`."""
    hasher = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            hasher.update(
                f"{value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes()
            )
        else:
            hasher.update(repr(value).encode("utf-8", "surrogatepass"))
    return hasher.hexdigest()


LENGTHS, VIDEO, SIDE = (12, 9), 4, 32  # steps of the episodes, of which so many are video; pixels
H5 = "record_dataset_PickXtimes.h5"


def write_recording(folder: Path) -> None:
    """A file in the layout of RoboMME's recorder."""
    write_file(folder / H5, LENGTHS, videos=[VIDEO, VIDEO], size=SIDE)


def write_dataset(folder: Path) -> None:
    """The same as a LeRobot dataset with videos, without checksums."""
    work = folder / "recording"
    work.mkdir()
    write_recording(work)
    convert(list_episodes(find_files([work])), folder / "dataset")
    shutil.rmtree(work)
    (folder / "dataset" / "SHA256SUMS").unlink(missing_ok=True)


class SyntheticSource:
    """The part of an `EpisodeSource` that a cache reads."""

    name, fingerprint = "fuzzed", "0123456789abcdef"
    lengths, exec_starts = np.array(LENGTHS), np.array([VIDEO, VIDEO])
    robot, columns = ROBOMME_JOINT, {"front": "image", "wrist": "wrist_image"}

    def __len__(self) -> int:
        return len(LENGTHS)

    def rendered(self, episode: int, camera: str | None = None) -> np.ndarray:
        return np.ones(LENGTHS[episode], bool)

    def frames(self, episode: int, indices: Any, camera: str | None = None) -> np.ndarray:
        values = np.random.default_rng(episode).integers(
            0, 255, (LENGTHS[episode], SIDE, SIDE, 3), np.uint8
        )
        return values[np.asarray(indices)]


def _memory() -> TokenDrop:
    return TokenDrop(d_vision=8, width=8, budget=8, grid=2, stride=2)


def _encode(frames: np.ndarray) -> Tensor:
    return torch.from_numpy(frames.reshape(len(frames), -1)[:, :32].astype(np.float32)).view(
        -1, 4, 8
    )


def expected_fingerprint() -> dict[str, Any]:
    source: Any = SyntheticSource()
    return fingerprint(source, _memory().storage, "encoder")


def write_cache(folder: Path) -> None:
    """The vision cache of two episodes, with scores."""
    source: Any = SyntheticSource()
    build_cache(source, _memory(), _encode, folder / "cache", expected_fingerprint(), shard=(0, 1))


def write_logs(folder: Path) -> None:
    """Records of five episodes and the settings of their run."""
    begin_run(folder, {"checkpoint": "a", "seed": 7, "tasks": ["PickXtimes"]}, {"device": "cpu"})
    with RecordLog(folder / RECORDS) as log:
        for episode in range(5):
            outcome = "success" if episode % 2 else "timeout"
            log.append(
                EpisodeRecord(
                    "pi05",
                    60000,
                    7,
                    "PickXtimes",
                    episode,
                    500 + episode,
                    "easy",
                    outcome,
                    300 + episode,
                    seconds=Seconds(1.5, 0.25, 2.0),
                    when="2026-01-01T00:00:00+00:00",
                    extra={"score": 0.5},
                )
            )


QUESTION = ("You plan.", [("user", ["What next?"])])


def _api(folder: Path, reply: str) -> Api:
    api = Api(Settings(cache=str(folder / "answers")), Usage(), client=object())
    api._request = lambda system, messages: Reply(reply, 12, 7)  # type: ignore[method-assign]
    return api


def write_answers(folder: Path) -> None:
    """One answer that was kept."""
    _api(folder, "pick up the cube at <1, 2>").ask(*QUESTION)


def read_answers(folder: Path) -> object:
    """The kept answer; where it is damaged the question is asked again, and answered in the same
    words.
    """
    reply = _api(folder, "pick up the cube at <1, 2>").ask(*QUESTION)
    return reply.text, reply.input_tokens, reply.output_tokens


class _Words:
    def encode(self, text: str, add_special_tokens: bool) -> list[str]:
        return text.split()


def write_rows(folder: Path) -> None:
    """Two rows, one with an image and a point, one with a video."""
    images = np.random.default_rng(0).integers(0, 255, (12, 32, 32, 3), np.uint8)
    (folder / "a.png").write_bytes(png_bytes(images[0]))
    (folder / "a.mp4").write_bytes(video_bytes(images))
    rows: list[dict[str, Any]] = [
        {
            "messages": _messages("<image> What next?", "pick up at <bbox>"),
            "images": ["a.png"],
            "objects": {"bbox": [[1, 2]]},
        },
        {"messages": _messages("<video> What next?", "stop"), "videos": ["a.mp4"]},
    ]
    (folder / "simple.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    write_sums(folder, ["simple.jsonl", "a.png", "a.mp4"])


def _messages(user: str, reply: str) -> list[dict[str, str]]:
    texts = {"system": "You plan.", "user": user, "assistant": reply}
    return [{"role": role, "content": text} for role, text in texts.items()]


def read_rows(folder: Path) -> object:
    """Every question with its images."""
    dataset = RowDataset(folder / "simple.jsonl", _Words())
    read: list[object] = [len(dataset), dataset.left_out]
    for i in range(len(dataset)):
        question = dataset[i]
        read += [question.system, question.user, question.target, *question.images]
        read += [
            array for clip in question.videos for array in (clip.frames, clip.indices, clip.length)
        ]
    return digest(*read)
