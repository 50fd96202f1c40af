"""Render a `Model` with Mitsuba 3. Mitsuba is imported on first use: geometry and layout do not need it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from nerfdiff.errors import ConfigError
from nerfdiff.scenes.mesh import Colour, Model, Part
from nerfdiff.scenes.poses import FOCAL_PER_PIXEL


@dataclass(frozen=True)
class Views:
    """Rendered views of one object.

    Args:
        rgb: on white.
        depth: distance along the camera's z axis where the ray through a pixel's centre hits, else 0.
        mask: whether that ray hits.
    """

    rgb: UInt8[np.ndarray, "views height width 3"]
    depth: Float[np.ndarray, "views height width"]
    mask: Bool[np.ndarray, "views height width"]


def resolve_variant(variant: str) -> str:
    """`auto` becomes `cuda_ad_rgb` where Mitsuba finds a CUDA device, else `scalar_rgb`.

    Raises:
        ConfigError: this Mitsuba has no such variant.
    """
    import drjit
    import mitsuba

    if variant == "auto":
        return "cuda_ad_rgb" if drjit.has_backend(drjit.JitBackend.CUDA) else "scalar_rgb"
    if variant not in mitsuba.variants():
        raise ConfigError(f"variant={variant}: expected auto or one of {', '.join(mitsuba.variants())}")
    return variant


def srgb_to_linear(value: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """IEC 61966-2-1, from [0, 1] to [0, 1]."""
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb8(value: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """IEC 61966-2-1, clipped to [0, 1] and rounded to 8 bits."""
    value = np.clip(value, 0, 1)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(encoded * 255).astype(np.uint8)


class MitsubaRenderer:
    """Renders on one thread: many processes share the work, and results do not depend on their number.

    Args:
        variant: a Mitsuba variant, not `auto`.
        resolution: pixels per side.
        samples_per_pixel: for colour; depth and mask take the one ray through the pixel's centre.
    """

    def __init__(self, variant: str, resolution: int, samples_per_pixel: int):
        import drjit
        import mitsuba

        if mitsuba.variant() != variant:
            mitsuba.set_variant(variant)
        drjit.set_thread_count(1)
        self.mi = mitsuba
        self.resolution = resolution
        self.samples_per_pixel = samples_per_pixel
        # hide_emitters leaves the background transparent; depth 3 is one bounce between surfaces.
        self.colour = mitsuba.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
        self.first_hit = mitsuba.load_dict({"type": "aov", "aovs": "p:position,n:geo_normal"})

    def render(self, model: Model, c2w: Float[np.ndarray, "views 4 4"], seed: int) -> Views:
        """Render `model` from every pose; `seed` fixes the noise."""
        scene = self._scene(model)
        rgb, depth, mask = zip(*(self._view(scene, pose, seed + 7919 * k) for k, pose in enumerate(c2w)), strict=True)
        return Views(np.stack(rgb), np.stack(depth), np.stack(mask))

    def _view(self, scene, pose, seed):
        mi = self.mi
        seed %= 2**32
        sensor = self._sensor(pose, {"type": "multijitter", "sample_count": self.samples_per_pixel})
        image = np.array(mi.render(scene, sensor=sensor, integrator=self.colour, seed=seed, spp=self.samples_per_pixel))
        alpha = np.clip(image[..., 3:4], 0, 1)
        rgb = linear_to_srgb8(np.clip(image[..., :3], 0, None) + (1 - alpha))

        # One stratum without jitter is the pixel's centre, and a box filter keeps pixels apart.
        centre = self._sensor(pose, {"type": "stratified", "sample_count": 1, "jitter": False})
        hit = np.array(mi.render(scene, sensor=centre, integrator=self.first_hit, seed=0, spp=1))
        position, normal = hit[..., -6:-3], hit[..., -3:]
        mask = (normal**2).sum(-1) > 0.5
        depth = np.where(mask, (position.astype(np.float64) - pose[:3, 3]) @ pose[:3, 2], 0.0)
        return rgb, depth, mask

    def _sensor(self, pose, sampler):
        mi = self.mi
        centre, forward, up = pose[:3, 3], pose[:3, 2], -pose[:3, 1]
        return mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.rad2deg(2 * np.arctan(0.5 / FOCAL_PER_PIXEL))),
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 100.0,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=centre.tolist(), target=(centre + forward).tolist(), up=up.tolist()
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": self.resolution,
                    "height": self.resolution,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": sampler,
            }
        )

    def _scene(self, model: Model):
        mi = self.mi
        entries = {
            "type": "scene",
            # A bright sky all around plus a soft-edged sun from above and the front right: tops are
            # lightest, undersides darkest, and little depends on the viewing direction.
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.70}},
            "sun": {
                "type": "directional",
                "direction": [-0.35, 0.45, -0.82],
                "irradiance": {"type": "rgb", "value": 1.5},
            },
        }
        groups: dict[tuple, list[Part]] = {}
        for part in model.parts:
            groups.setdefault((part.finish, part.colour), []).append(part)
        for k, ((finish, colour), parts) in enumerate(groups.items()):
            entries[f"mesh_{k:03d}"] = self._mesh(parts, self._bsdf(finish, colour))
        return mi.load_dict(entries)

    def _mesh(self, parts: list[Part], bsdf: dict):
        mi = self.mi
        offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
        vertices = np.concatenate([p.vertices for p in parts])
        faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)])

        props = mi.Properties()
        props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf})
        props["face_normals"] = True
        mesh = mi.Mesh("parts", len(vertices), len(faces), props=props)
        params = mi.traverse(mesh)
        params["vertex_positions"] = type(params["vertex_positions"])(vertices.astype(np.float32).ravel())
        params["faces"] = type(params["faces"])(faces.astype(np.uint32).ravel())
        params.update()
        return mesh

    @staticmethod
    def _bsdf(finish: str, colour: Colour) -> dict:
        reflectance = {"type": "rgb", "value": srgb_to_linear(np.array(colour)).tolist()}
        if finish == "matte":
            return {"type": "diffuse", "reflectance": reflectance}
        # A clear coat with a mild index of refraction: a hint of sheen over a diffuse colour.
        return {
            "type": "plastic",
            "diffuse_reflectance": reflectance,
            "int_ior": 1.30 if finish == "paint" else 1.45,
            "specular_reflectance": {"type": "rgb", "value": 0.5 if finish == "paint" else 0.9},
        }
