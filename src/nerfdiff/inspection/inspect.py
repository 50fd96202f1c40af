"""One inspection: every split of a dataset surveyed, pictures, a report."""

import sys
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.inspection.all_views import StrayCameras
from nerfdiff.inspection.bounds_plot import Distances, write_bounds_plot
from nerfdiff.inspection.camera_plot import PlottedCameras, write_camera_plot
from nerfdiff.inspection.check import Check
from nerfdiff.inspection.report import print_report, write_report
from nerfdiff.inspection.sheet import write_sheet
from nerfdiff.inspection.summary import SplitSummary, summarise_split
from nerfdiff.inspection.survey import Sample, SplitSurvey, sampled, survey_split
from nerfdiff.utils.errors import DataError


def inspect_data(cfg: DictConfig) -> list[SplitSummary]:
    """Inspect the dataset of `cfg.data`.

    Leaves in `cfg.paths.output_dir` for each split `<split>_cameras.png`, `<split>_bounds.png` and
    `<split>_sheet.png`, beside `report.md` and `report.json`; prints the report.

    Returns:
        a summary for each of train, val and test.

    Raises:
        DataError: no split can be read; or, after the report is written, a check failed, a scene is bad, or nothing
            could tell whether cameras fit images (unless `cfg.allow_unchecked`).
    """
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    datamodule: SceneDataModule = instantiate(cfg.data)
    checks: dict[str, Check] = {name: instantiate(check) for name, check in cfg.checks.items() if check is not None}
    strays: StrayCameras | None = instantiate(cfg.stray_cameras)
    folder, console = Path(cfg.paths.output_dir), Console(width=None if sys.stdout.isatty() else 200)
    readers, summaries, errors = {}, {}, []
    for stage in datamodule.splits:
        try:
            readers[stage] = datamodule.reader(stage)
        except DataError as error:
            errors.append(error)
            why = {"absent" if isinstance(error, MissingSplit) else "error": str(error)}
            summaries[stage] = SplitSummary(stage, datamodule.splits[stage], **why)
    if not readers:
        raise errors[0]
    for stage, reader in readers.items():
        survey = _survey(cfg, datamodule, stage, reader, checks, strays)
        summaries[stage] = summarise_split(survey, checks, strays, _pictures(cfg, survey, folder), cfg.allow_unchecked)
    splits = [summaries[stage] for stage in datamodule.splits]
    title = f"{datamodule.name} in {Path(datamodule.root).resolve()}"
    report = write_report(folder, title, splits)
    print_report(console, title, splits, cfg.listed)
    pictures = [folder / name for split in splits for name in split.pictures.values()]
    console.print("Open:", *(f"  {path}" for path in [*report, *pictures]), sep="\n", soft_wrap=True, markup=False)
    failures = [f"{split.stage}: {', '.join(split.failures)}" for split in splits if split.failures]
    if failures:
        raise DataError(f"{datamodule.root}: {'; '.join(failures)}; see {report[0]}")
    return splits


def _survey(
    cfg: DictConfig,
    datamodule: SceneDataModule,
    stage: str,
    reader: SceneReader,
    checks: dict[str, Check],
    strays: StrayCameras | None,
) -> SplitSurvey:
    sources = {
        "train": datamodule.train_source_view,
        "val": datamodule.val_source_view,
        "test": datamodule.source_view,
    }
    sample = Sample(
        cfg.sample.scenes, cfg.sample.views, cfg.bounds_plot.distances, cfg.sheet.scenes, cfg.sheet.views, cfg.seed
    )
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    steps = len(reader) + len(sampled(len(reader), cfg.sample.scenes, ""))
    with Progress(*columns, disable=not sys.stderr.isatty(), console=Console(stderr=True)) as bar:
        task = bar.add_task(f"{stage}: listing and reading scenes", total=steps)
        return survey_split(
            stage,
            datamodule.splits[stage],
            reader,
            sources[stage],
            sample,
            checks,
            strays,
            lambda: bar.update(task, advance=1),
        )


def _pictures(cfg: DictConfig, survey: SplitSurvey, folder: Path) -> dict[str, str]:
    """Draws what there is of cameras, bounds and images; file names by what they show."""
    title = f"{cfg.data.name}, {survey.stage}"
    cameras = [PlottedCameras(r.id, r.cameras, r.views, r.source) for r in survey.records]
    distances = [Distances(r.distances.numpy(), r.near, r.far, r.evidence) for r in survey.records]
    paths = {what: folder / f"{survey.stage}_{what}.png" for what in ("cameras", "bounds", "sheet")}
    written = {
        "cameras": write_camera_plot(paths["cameras"], cameras, f"{title}: cameras", **cfg.camera_plot),
        "bounds": write_bounds_plot(
            paths["bounds"], distances, f"{title}: near and far", cfg.bounds_plot.bins, cfg.bounds_plot.dpi
        ),
        "sheet": write_sheet(paths["sheet"], [r.row for r in survey.records], cfg.sheet.max_cell, cfg.sheet.min_cell),
    }
    return {what: path.name for what, path in written.items() if path is not None}
