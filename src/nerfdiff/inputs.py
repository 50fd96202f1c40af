"""Files and folders that commands read, looked for without importing anything slow."""

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nerfdiff.utils.errors import CheckpointError, ConfigError, DataError

PACKAGE = Path(__file__).parent
CHECKOUT = None if (PACKAGE / "conf").is_dir() else PACKAGE.parents[1]
"""The project's folder; None where the package is installed from a wheel, which holds conf/ and assets/ itself."""

CONF, ASSETS = ((CHECKOUT or PACKAGE) / name for name in ("conf", "assets"))
WEIGHTS = "model.safetensors"
FORMATS = ("glb", "obj", "ply", "html", "mp4", "gif", "png")
NO_SCENE = ("cdm", "copy_input", "mean_image")
"""Strategies that predict views and leave no field."""
LAST, PREVIOUS = "last.ckpt", "previous.ckpt"


def checkpoints(run: str | Path) -> list[Path]:
    """List a run's checkpoint to resume from, the one before it, and what there is beside them, as last-v1.ckpt."""
    folder = Path(run) / "checkpoints"
    return [*(folder / name for name in (LAST, PREVIOUS)), *sorted(folder.glob(f"{Path(LAST).stem}-v*.ckpt"))]


def find_weights(ckpt: str | Path, assets: str | Path | None, key: str = "ckpt") -> Path:
    """The file of a model's weights.

    Args:
        ckpt: a Lightning `.ckpt`; a run's folder (its last checkpoint); a folder written by `export_model`; or the
            name of such a folder in `assets`, as `demo`.
        assets: folder of shipped models; None is the one that comes with the program.
        key: that named it, for the message.

    Raises:
        CheckpointError: there is no such file.
    """
    assets = Path(assets or ASSETS)
    candidates = [Path(ckpt), *checkpoints(ckpt), Path(ckpt) / WEIGHTS, assets / ckpt / WEIGHTS]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        shipped = sorted(file.parent.name for file in assets.glob(f"*/{WEIGHTS}"))
        raise CheckpointError(
            f"{key}={ckpt} is neither a file nor a folder of a run; looked for "
            f"{', '.join(map(str, candidates))}. Shipped models: {', '.join(shipped) or 'none'}"
        )
    return path


def check_inputs(
    cfg: DictConfig, keys: Collection[str], swept: Collection[str] = (), only: Collection[str] | None = None
) -> None:
    """Refuse a composed config whose checkpoint, picture, dataset or results are not there.

    Args:
        keys: what the command reads, among `ckpt`, `init`, `image`, `images`, `picture.mask`, `fields`, `data.root`,
            `shards` and `results`. With an `image` no dataset is read.
        swept: keys that every job of a sweep sets for itself, which are the jobs' to check.
        only: keys whose files are looked for; None is all.

    Raises:
        UserError: naming the key, what it says and what it should.
    """
    for key in keys:
        value = None if key in swept else _value(cfg, key)
        if value is None or (only is not None and key not in only) or (key == "data.root" and cfg.get("image")):
            continue
        if key in ("ckpt", "init"):
            find_weights(value, cfg.paths.assets_dir, key)
        elif key == "shards":
            if not Path(value).is_dir():
                raise DataError(f"shards={value}: no such folder; name the one in which the shards were made")
        elif key == "data.root":
            if not OmegaConf.select(cfg, "data.shards") and not Path(value).is_dir():
                raise DataError(f"data.root={value}: no such folder; set data.root to the folder of the dataset")
        elif key == "results":
            for place in [value] if isinstance(value, str) else value:
                if not Path(place).exists():
                    raise DataError(f"results={place}: no such file or folder; name folders of runs, or their files")
        else:
            for file in [value] if isinstance(value, str) else value:
                check_file(key, file, "name a field.safetensors" if key == "fields" else "name a picture")


def check_file(key: str, file: str, instead: str) -> None:
    """Raise DataError where there is no such file; `instead` says what to do."""
    if not Path(file).is_file():
        what = "no such file"
        if Path(file).exists():
            what = "is a folder" if Path(file).is_dir() else "is no ordinary file"
        raise DataError(f"{key}={file}: {what}; {instead}")


def check_formats(formats: Collection[str]) -> None:
    """Raise ConfigError where a format is not one of `FORMATS`."""
    if unknown := sorted(set(formats) - set(FORMATS)) or not formats:
        raise ConfigError(f"format={unknown if formats else '[]'}: expected some of {', '.join(FORMATS)}")


def check_picture_settings(cfg: DictConfig) -> None:
    """Raise ConfigError where `conf/picture.yaml`'s settings leave no scene, or say twice where the object is."""
    box = cfg.cutout.box
    if cfg.strategy.name in NO_SCENE:
        raise ConfigError(f"strategy={cfg.strategy.name} leaves no scene: choose one that does, as ngd_current")
    if box is not None and (len(box) != 4 or not all(isinstance(edge, int | float) for edge in box)):
        raise ConfigError(f"box={list(box)}: expected [left, top, right, bottom] in pixels")
    if box is not None and cfg.mask is not None:
        raise ConfigError(f"box={list(box)} and mask={cfg.mask} both say where the object is: give one")


def check_box(box: Sequence[float], height: int, width: int) -> None:
    """Raise ConfigError where [left, top, right, bottom] are not within a picture, or too near to each other."""
    left, top, right, bottom = box
    if not (0 <= left < right <= width and 0 <= top < bottom <= height) or min(right - left, bottom - top) < 8:
        raise ConfigError(
            f"box={list(box)}: expected [left, top, right, bottom] in pixels, at least 8 apart, within the "
            f"picture's {width}x{height} (width x height, as it is shown)"
        )


def check_mask_size(mask: str, size: tuple[int, int], picture: str, expected: tuple[int, int]) -> None:
    """Raise DataError where a mask's (height, width) is not its picture's."""
    if size != expected:
        (h, w), (rows, columns) = size, expected
        raise DataError(
            f"{mask}: a mask of {h}x{w} for {picture} of {rows}x{columns} (height x width); expected one size"
        )


def check_output(cfg: DictConfig) -> None:
    """Refuse a composed config, Hydra's node included, whose run folder cannot be written.

    Raises:
        DataError: naming the folder, and why.
    """
    if cfg.hydra.output_subdir is None:
        return
    folder = Path(str(cfg.hydra.run.dir)).absolute()
    there = next(parent for parent in (folder, *folder.parents) if os.path.lexists(parent))
    if not there.is_dir():
        why = f"{there} is a link that leads nowhere" if there.is_symlink() else f"{there} is no folder"
    elif not os.access(there, os.W_OK | os.X_OK):
        why = f"{there} cannot be written"
    else:
        return
    raise DataError(f"the run's folder {folder}: {why}; choose another paths.runs_dir or paths.run_dir")


def _value(cfg: DictConfig, key: str) -> Any:
    """Return a key's value; None where it cannot be told before the job runs."""
    try:
        return OmegaConf.select(cfg, key, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise ConfigError(f"{key} must be given: add {key}=<value>") from error
    except OmegaConfBaseException:
        return None
