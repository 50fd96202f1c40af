"""The stresses of `conf/stress`, read without composing a command."""

from omegaconf import DictConfig, OmegaConf

from nerfdiff.inputs import CONF

NONE = "none"


def stress_files() -> dict[str, DictConfig]:
    """Return every stress by its axis, interpolations unresolved."""
    common = OmegaConf.load(CONF / "common" / "stress.yaml")
    found = {path.stem: OmegaConf.merge(common, OmegaConf.load(path)) for path in (CONF / "stress").glob("*.yaml")}
    return {axis: found[axis] for axis in sorted(found) if axis != NONE}
