"""The orbits of a sweep in one video: a column for every row of its table, a row for every scene."""

from collections.abc import Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch
from omegaconf import DictConfig
from PIL import Image, ImageDraw, ImageFont

from nerfdiff.evaluation.predict import ORBIT
from nerfdiff.metrics.predictions import read_plan
from nerfdiff.results.pictures import INK, PAPER, orbit_video
from nerfdiff.sweeps.jobs import Group, shown_predictions

HEADING = 24
"""Pixels above each column for its name."""


def orbits(path: Path, groups: Sequence[Group], options: DictConfig) -> Path | None:
    """Save the orbits that the first seed's jobs left of the first scenes.

    Args:
        options: how many `scenes`, and `fps`.

    Returns:
        `path`; None where not all jobs left orbits of the same scenes.
    """
    shown = shown_predictions(groups)
    if not shown:
        return None
    planned = read_plan(next(iter(shown.values())))["scenes"]
    common = [scene for scene in planned if all((folder / scene / ORBIT).is_file() for folder in shown.values())]
    common = common[: options.scenes]
    if not common:
        return None
    columns = []
    for name, folder in shown.items():
        videos = [np.stack(imageio.mimread(folder / scene / ORBIT, memtest=False)) for scene in common]
        frames = np.concatenate(videos, 1)
        columns.append(np.concatenate([_heading(name, frames.shape[2])[None].repeat(len(frames), 0), frames], 1))
    frames = torch.from_numpy(np.concatenate(columns, 2)).permute(0, 3, 1, 2)
    return orbit_video(path, frames.float() / 255, options.fps, min_size=1)


def _heading(name: str, width: int) -> np.ndarray:
    image = Image.new("RGB", (width, HEADING), PAPER)
    font = ImageFont.load_default(size=HEADING * 2 // 3)
    ImageDraw.Draw(image).text((width / 2, HEADING / 2), name, INK, font, anchor="mm")
    return np.asarray(image)
