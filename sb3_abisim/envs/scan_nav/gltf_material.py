"""Materials of glTF 2.0 (sections 3.8 and 3.9): the color of a surface in even light, and where one sees through it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.gltf_file import GltfFile
from sb3_abisim.envs.scan_nav.images import Image, Images
from sb3_abisim.envs.scan_nav.surfaces import CLAMP, HALF_SEEN, MIRROR, REPEAT

_WRAPS = {10497: REPEAT, 33071: CLAMP, 33648: MIRROR}
_OPAQUE = "OPAQUE"


@dataclass(frozen=True)
class Look:
    """What a material shows.

    :param factor: RGB in 0..255, as shown on a screen
    :param texture: index of the color texture, or None
    :param tex_coord: which of a part's sets of coordinates the texture uses
    :param offset: added to the coordinates, after the scale
    :param scale: of the coordinates
    :param alpha: the material's factor, 0..1
    :param cutoff: where alpha counts, the least of what is there; None for opaque
    :param tinted: whether the colors of vertices multiply it
    :param veiled: whether the texture's alpha counts, which that of emitted light does not
    """

    factor: NDArray[np.float32]
    texture: int | None = None
    tex_coord: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    alpha: float = 1.0
    cutoff: float | None = None
    tinted: bool = True
    veiled: bool = True


def plain_look() -> Look:
    """Of a part without a material: white."""
    return Look(np.full(3, 255, dtype=np.float32))


def read_look(file: GltfFile, material: dict[str, Any]) -> Look:
    """What a material shows.

    :param file: that it is from
    :param material: its entry
    :raises SceneError: for what is not known to be read right
    """
    extensions = material.get("extensions", {})
    rough, glossy = material.get("pbrMetallicRoughness", {}), extensions.get("KHR_materials_pbrSpecularGlossiness", {})
    base = glossy.get("diffuseFactor") or rough.get("baseColorFactor") or [1, 1, 1, 1]
    color = _numbers(file, base, 4)
    reference = glossy.get("diffuseTexture") or rough.get("baseColorTexture")
    # Light that a surface gives off is shown where it is all that there is to see.
    glow = _numbers(file, material.get("emissiveFactor", [0, 0, 0]), 3)
    glow = glow * float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1))
    glowing = reference is None and glow.any()
    tinted = True
    if glowing and "emissiveTexture" in material:
        reference, color, tinted = material["emissiveTexture"], np.append(glow, color[3]), False
    elif glowing and not color[:3].any():
        color, tinted = np.append(glow, color[3]), False
    # glTF's factors are linear light; they are rounded to 256 steps.
    linear = np.rint(np.clip(color[:3], 0, 1) * 255).astype(np.float32) / 255
    factor = (255 * linear ** (1 / 2.2)).astype(np.float32)
    alpha, cutoff = _alpha(file, material, float(np.clip(color[3], 0, 1)))
    if reference is None:
        return Look(factor, alpha=alpha, cutoff=cutoff, tinted=tinted)
    moved = reference.get("extensions", {}).get("KHR_texture_transform", {})
    if moved.get("rotation", 0) != 0:
        raise SceneError(
            f"{file.path} has a color texture turned by KHR_texture_transform, which is not supported; bake the "
            "texture (in Blender) and export it again"
        )
    offset, scale = _numbers(file, moved.get("offset", [0, 0]), 2), _numbers(file, moved.get("scale", [1, 1]), 2)
    return Look(
        factor,
        reference["index"],
        moved.get("texCoord", reference.get("texCoord", 0)),
        (float(offset[0]), float(offset[1])),
        (float(scale[0]), float(scale[1])),
        alpha,
        cutoff,
        tinted,
        reference is not material.get("emissiveTexture"),
    )


def _alpha(file: GltfFile, material: dict[str, Any], alpha: float) -> tuple[float, float | None]:
    mode = material.get("alphaMode", _OPAQUE)
    if mode not in (_OPAQUE, "MASK", "BLEND"):
        raise file.bad(f"has a material whose alphaMode is {mode!r}")
    cutoff = None if mode == _OPAQUE else HALF_SEEN if mode == "BLEND" else float(material.get("alphaCutoff", 0.5))
    glass = material.get("extensions", {}).get("KHR_materials_transmission", {})
    if float(glass.get("transmissionFactor", 0)) > HALF_SEEN:
        if "transmissionTexture" in glass:
            raise file.bad(
                "has a material that lets light through by a texture (KHR_materials_transmission), which is not "
                "supported",
                "export it without",
            )
        return 0.0, HALF_SEEN
    return alpha, cutoff


def read_texture(file: GltfFile, images: Images, index: int) -> tuple[tuple[str, Image] | None, tuple[str, str]]:
    """A texture.

    :param file: that it is from
    :param images: decodes it
    :param index: of it
    :return: name and content, None for a file that is not there; how it goes on beyond its borders
    :raises SceneError: for one that cannot be decoded
    """
    texture = file.item("textures", index)
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    source = webp.get("source", texture.get("source"))
    sampler = file.item("samplers", texture["sampler"]) if "sampler" in texture else {}
    modes = [sampler.get(name, 10497) for name in ("wrapS", "wrapT")]
    if any(mode not in _WRAPS for mode in modes):
        raise file.bad(f"has a texture whose wrapping is {modes}")
    wrap = (_WRAPS[modes[0]], _WRAPS[modes[1]])
    if source is None:
        other = ", ".join(sorted(texture.get("extensions", {}))) or "no image"
        raise file.bad(
            f"has a texture in no form that can be decoded ({other})",
            "export it with PNG or JPEG textures; `npx @gltf-transform/cli ktxdecompress IN OUT` converts KTX2",
        )
    entry = file.item("images", source)
    key = f"{entry['name']} ({source})" if entry.get("name") else f"image {source}"
    if "bufferView" in entry:
        return (key, images.decode(file.view(entry["bufferView"]), key)), wrap
    uri = entry.get("uri")
    if isinstance(uri, str) and not uri.startswith("data:"):
        found = file.files.find(uri)
        return (None if found is None else (found, images.read(found))), wrap
    return (key, images.decode(file.uri(uri, "a texture") or b"", key)), wrap


def _numbers(file: GltfFile, values: Any, n: int) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (n,) or not np.isfinite(array).all():
        raise file.bad(f"has a material with {values!r} where {n} numbers must be")
    return array
