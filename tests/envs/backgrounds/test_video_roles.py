"""Which folders and files are clips, which are not, and that it is said."""

import os
import shutil

import numpy as np
import pytest
from video_inputs import Image, empty_cache, videos_folder, write_frames, write_video  # noqa: F401

from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.video_files import find_sources
from sb3_abisim.envs.backgrounds.video_roles import is_other_role


def images(folder, seed=0, n=16):
    folder.mkdir(parents=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    for i in range(n):
        Image.fromarray(np.roll(pixels, i, 1)).save(folder / f"{i:05d}.jpg")


def masks(folder, mode="P", pattern="{:05d}.png", n=16):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(n):
        pixels = np.zeros((24, 32), np.uint8)
        pixels[8:20, i : 10 + i] = 1
        image = Image.fromarray(pixels)
        if mode == "P":
            image.putpalette([0, 0, 0, 128, 0, 0])
        elif mode == "RGB":
            image = Image.fromarray(np.stack([pixels * 128, pixels * 0, pixels], 2))
        elif mode == "depth":
            image = Image.fromarray(np.arange(24 * 32, dtype=np.uint16).reshape(24, 32).astype(np.uint8))
        image.save(folder / pattern.format(i))


def names(root):
    return {split: sorted(load_backgrounds(root, split).names) for split in ("train", "eval")}


def test_masks_of_mose_are_left_out(folder):
    for seed, clip in enumerate(("a", "b", "c", "d")):
        images(folder / "JPEGImages" / clip, seed), masks(folder / "Annotations" / clip)
    with pytest.warns(UserWarning, match=r"left out of 4 clips in .*: Annotations \(masks, depth or the like"):
        sides = names(folder)
    assert sorted(sides["train"] + sides["eval"]) == [f"JPEGImages/{clip}" for clip in "abcd"]
    assert len(sides["eval"]) == 1  # each is a group of its own


def test_masks_of_youtube_vos_are_left_out(folder):
    for seed, (side, clip) in enumerate((s, c) for s in ("train", "valid") for c in "ab"):
        (
            images(folder / side / "JPEGImages" / (side + clip), seed),
            masks(folder / side / "Annotations" / (side + clip)),
        )
    images(folder / "train_all_frames" / "x", 9)
    with pytest.warns(UserWarning, match=r"left out") as warned:
        sides = names(folder)
    assert sides["train"] == ["train/JPEGImages/traina", "train/JPEGImages/trainb"]
    assert sides["eval"] == ["valid/JPEGImages/valida", "valid/JPEGImages/validb"]
    text = str(warned[0].message)
    assert "train/Annotations" in text and "train_all_frames (beside the folders of the two sides)" in text


@pytest.mark.parametrize("sizes", [["Full-Resolution"], ["480p", "Full-Resolution"]])
def test_davis_of_any_resolution(folder, sizes):
    for size in sizes:
        for seed, clip in enumerate(("bear", "camel", "dog")):
            images(folder / "JPEGImages" / size / clip, seed), masks(folder / "Annotations" / size / clip)
    (folder / "ImageSets" / "2017").mkdir(parents=True)
    (folder / "ImageSets" / "2017" / "train.txt").write_text("bear\ncamel\n")
    (folder / "ImageSets" / "2017" / "val.txt").write_text("dog\n")
    assert names(folder) == {"train": ["bear", "camel"], "eval": ["dog"]}
    assert {source.path.parent.name for source in find_sources(folder)} == {sizes[0]}


def test_depth_beside_images_of_each_clip(folder):
    for seed, clip in enumerate(("x", "y")):
        images(folder / clip / "rgb", seed), masks(folder / clip / "depth", "depth")
        masks(folder / f"{clip}_mask")
    with pytest.warns(UserWarning, match="x/depth.*x_mask|x_mask.*x/depth"):
        assert sorted(source.name for source in find_sources(folder)) == ["x/rgb", "y/rgb"]
        assert sorted(source.group for source in find_sources(folder)) == ["x", "y"]


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("P", "z holds masks"),
        ("L", "z holds masks"),
        ("RGB", "images of few colors beside"),
        ("depth", "of gray beside"),
    ],
)
def test_masks_of_an_unknown_name_are_refused(folder, mode, said):
    images(folder / "a"), images(folder / "b", 1), masks(folder / "z", mode)
    with pytest.raises(ValueError, match=said):
        find_sources(folder)


def test_masks_among_their_frames_are_refused(folder):
    for pattern in ("{:05d}.png", "{:05d}_mask.png", "depth{}.png"):
        images(folder / "a"), masks(folder / "a", pattern=pattern)
        with pytest.raises(ValueError, match=r"a holds several images of one number, N\.jpg and "):
            find_sources(folder)
        shutil.rmtree(folder / "a")


def test_frames_of_two_suffixes_that_go_on_are_one_clip(folder):
    write_frames(folder / "a", 1, range(10)), write_frames(folder / "a", 1, range(10, 20), "frame{}.jpg")
    assert [len(source.files) for source in find_sources(folder)] == [20]


def test_videos_of_masks(folder):
    for name in ("walk.mp4", "walk_depth.mp4", "Mask.mp4"):
        (folder / name).touch()
    with pytest.warns(UserWarning, match=r"walk_depth\.mp4 \(masks"):
        assert [source.name for source in find_sources(folder)] == ["Mask.mp4", "walk.mp4"]


def test_words():
    assert all(is_other_role(name, ()) for name in ("Annotations", "ground-truth", "Optical_Flow", "MASKS"))
    assert not any(is_other_role(name, ()) for name in ("masked_singer", "depths_of_wikipedia", "bear", "bear_mask"))


@pytest.mark.parametrize(
    "name",
    [
        "depth_png", "masks_v2", "SegmentationClass", "gtFine", "labelIds", "flow_vis", "normal_maps", "sem_seg",
        "Mask0", "DepthMaps_16bit", "optical-flow-png", "pred_masks", "trimaps", "alpha_1",
    ],
)  # fmt: skip
def test_roles_with_words_about_their_form(name):
    assert is_other_role(name, ("rgb", name)) and is_other_role(name, ("video", name), alone=False)


def test_a_doubtful_word_is_a_role_beside_color_or_its_clip_alone():
    assert not any(is_other_role(name, (name, "walk")) for name in ("alpha_1", "normal_02", "flow-left"))
    assert is_other_role("depth_png", ("depth_png", "walk"))
    assert all(is_other_role(name, (name, "walk_1")) for name in ("walk_1_alpha", "mask_walk_1", "walk1-sem-seg-png"))
    assert not any(is_other_role(name, (name, "rgb")) for name in ("rgb", "walk", "images", "left", "1", "right_color"))


def test_kinds_that_are_not_read_are_named(folder):
    for name in ("a.mp4", "b.mp4", "c.wmv", "d.TS", "e.flv", "f.3gp", "x/g.heic", "notes.txt", "README"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    with pytest.warns(UserWarning) as warned:
        find_sources(folder)
    text = str(warned[0].message)
    assert all(
        f"{name} (of a kind that is not read)" in text for name in ("c.wmv", "d.TS", "e.flv", "f.3gp", "x/g.heic")
    )
    assert "notes" not in text and "README" not in text


def test_pipes_and_links_to_nothing_do_not_hang(folder):
    for name in ("a.mp4", "b.mp4"):
        (folder / name).touch()
    os.mkfifo(folder / "c.mp4"), os.mkfifo(folder / "d.webp")
    (folder / "e.mp4").symlink_to(folder / "nothing"), (folder / "f.mp4").symlink_to("f.mp4")
    with pytest.warns(UserWarning) as warned:
        assert [source.name for source in find_sources(folder)] == ["a.mp4", "b.mp4"]
    assert all(f"{name} (no regular file" in str(warned[0].message) for name in ("c.mp4", "d.webp", "e.mp4", "f.mp4"))


def test_what_was_understood_is_printed_before_decoding(folder, capsys):
    images(folder / "a"), images(folder / "b", 1)
    load_backgrounds(folder)
    text = capsys.readouterr().err
    assert f"clips in {folder}:" in text and "a (16 frames)" in text and "  eval   " in text and "  train  " in text


def test_animated_webp_are_clips_each(folder):
    for seed in range(2):
        frames = [Image.new("RGB", (64, 64), (10 * i, 90 * seed, 7)) for i in range(20)]
        frames[0].save(folder / f"{seed}.webp", save_all=True, append_images=frames[1:], lossless=True)
    for split in ("train", "eval"):
        side = load_backgrounds(folder, split)
        assert side.lengths.tolist() == [20]
        shades = side.frames(np.zeros(20, int), np.arange(20))[:, 0, 5, 5]
        assert shades.tolist() == [10 * i for i in range(20)]
