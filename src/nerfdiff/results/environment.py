"""The hardware, versions and code that a number was measured with."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch


def environment(device: torch.device | str, precision: str | None = None) -> dict[str, Any]:
    """The environment and git fields of a `ResultRow`.

    Args:
        device: the device that did the work.
        precision: the trainer's or the strategy's, e.g. "bf16-mixed".
    """
    device = torch.device(device)
    versions = {
        "torch": str(torch.__version__),
        "cuda": torch.version.cuda if device.type == "cuda" else None,
        "lightning": version("lightning"),
        "hydra": version("hydra-core"),
    }
    return hardware(device) | versions | {"precision": precision} | git_state(Path(__file__).parent)


def hardware(device: torch.device) -> dict[str, str]:
    """`device` and `cpu` of a `ResultRow`."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return {"device": name, "cpu": cpu_name()}


def cpu_name() -> str:
    """The processor's model name, as the operating system gives it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def git_state(folder: Path) -> dict[str, Any]:
    """`git_sha` and `git_dirty` of the checkout that `folder` belongs to; None outside of one.

    An installed copy inside some checkout's ignored virtual environment does not belong to it.
    """
    sha = _git(folder, "rev-parse", "HEAD")
    if sha is None or _git(folder, "check-ignore", ".") is not None:
        return {"git_sha": None, "git_dirty": None}
    return {"git_sha": sha, "git_dirty": bool(_git(folder, "status", "--porcelain"))}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
