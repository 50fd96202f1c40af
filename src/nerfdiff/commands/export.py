"""Weights alone, for sharing: `python src/export.py ckpt=runs/mine out=shared dtype=float16`.

Or a scene for other programs: `python src/export.py field=field.safetensors format=glb,ply,mp4`.
"""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point
from nerfdiff.inputs import check_formats
from nerfdiff.utils.errors import ConfigError


@entry_point("export", "ckpt", "fields")
def main(cfg: DictConfig) -> None:
    """Averaged weights as safetensors with the settings that rebuild the model, or fields as meshes and pictures."""
    if (cfg.ckpt is None) == (not cfg.fields):
        raise ConfigError("say what to export: ckpt=<checkpoint> for a model's weights, or field=<field.safetensors>")
    if cfg.fields:
        check_formats(cfg.format)
        from nerfdiff.exports.export import export_fields  # slow to import: not for --cfg

        print(*export_fields(cfg, cfg.fields), sep="\n")
        return
    if cfg.out is None:
        raise ConfigError("out must be given: add out=<folder> for the model's weights")
    from nerfdiff.checkpoint import export

    print(export(cfg.ckpt, cfg.weights, cfg.out, cfg.dtype, cfg.paths.assets_dir, cfg.average, cfg.step, cfg.shared))


if __name__ == "__main__":
    main()
