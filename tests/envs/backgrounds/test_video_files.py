"""Finding custom videos, and dividing them into two sides."""

import pytest
from video_inputs import both, empty_cache, shown, videos_folder, write_frames, write_video  # noqa: F401

from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.video_files import find_sources, natural_key, split_sources


def listed(folder, **kwargs):
    sides = split_sources(find_sources(folder), kwargs.get("seed", 0), kwargs.get("eval_fraction", 0.25))
    return {side: {source.name: source.group for source in sources} for side, sources in sides.items()}


class TestSplit:
    def test_groups_stay_together(self, folder):
        for movie in range(8):
            for shot in range(3):
                (folder / f"movie{movie}").mkdir(exist_ok=True)
                (folder / f"movie{movie}" / f"{shot}.mp4").touch()
        names = ("Kitchen [abc-EFGH_12]-000.mp4", "x/Kitchen [abc-EFGH_12]-001.mp4", "y/abc-EFGH_12_000010_000020.mp4")
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).touch()
        sides = listed(folder)
        assert not set(sides["train"].values()) & set(sides["eval"].values())
        assert len(sides["train"]) + len(sides["eval"]) == 27
        assert len(set(sides["eval"].values())) == 2  # a quarter of nine
        groups = sides["train"] | sides["eval"]
        assert {groups[name] for name in names} == {"abc-EFGH_12"}
        assert groups["movie3/1.mp4"] == "movie3"
        assert listed(folder, seed=1) != sides == listed(folder)

    def test_no_shared_frame(self, folder):
        for i in range(5):
            write_frames(folder / f"clip{i}", i)
        hashes = [{f.tobytes() for i in range(side.n_clips) for f in shown(side, i)} for side in both(folder)]
        assert [len(side) for side in hashes] == [80, 20] and not hashes[0] & hashes[1]

    @pytest.mark.parametrize("side", ["val", "valid", "validation", "test"])
    def test_other_names_of_the_eval_side(self, folder, side):
        for name in ("train/0.mp4", f"{side}/0.mp4", f"{side}/1.mp4"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
        sides = listed(folder)
        assert sorted(sides["train"]) == ["train/0.mp4"]
        assert sorted(sides["eval"]) == [f"{side}/0.mp4", f"{side}/1.mp4"]

    def test_links_to_folders_are_followed_once(self, folder, tmp_path):
        write_frames(tmp_path / "disk" / "far", 1)
        write_frames(folder / "near", 2)
        (folder / "linked").symlink_to(tmp_path / "disk")
        (tmp_path / "disk" / "back").symlink_to(folder)
        assert [source.name for source in find_sources(folder)] == ["linked/far", "near"]

    def test_folders_named_train_and_eval(self, folder):
        for name in ("train/a/0.mp4", "train/b.mp4", "eval/a/0.mp4", "eval/c.mp4", "eval/d.mp4"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
        sides = listed(folder)
        assert sorted(sides["train"]) == ["train/a/0.mp4", "train/b.mp4"]
        assert sorted(sides["eval"]) == ["eval/a/0.mp4", "eval/c.mp4", "eval/d.mp4"]

    def test_davis_root_defines_the_split(self, folder):
        lists = folder / "ImageSets" / "2017"
        lists.mkdir(parents=True)
        (lists / "train.txt").write_text("bear\nboat\n\n")
        (lists / "val.txt").write_text("cows\n")
        for seed, name in enumerate(("bear", "boat", "cows", "unlisted")):
            write_frames(folder / "JPEGImages" / "480p" / name, seed, range(25), "{:05d}.jpg")
        train, evaluation = both(folder)
        assert train.names == ("bear", "boat") and evaluation.names == ("cows",)
        assert train.lengths.tolist() == [25, 25]
        (lists / "val.txt").write_text("camel\n")
        with pytest.raises(ValueError, match=r"val\.txt lists 'camel'"):
            find_sources(folder)
        (lists / "val.txt").unlink()
        with pytest.raises(ValueError, match=r"has no .*val\.txt; restore it"):
            find_sources(folder)

    def test_hidden_files_and_thumbnails_are_left_out(self, folder):
        for name in ("a.mp4", "a.jpg", "._a.mp4", ".trash/b.mp4", "c/0.mp4"):
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).touch()
        assert [source.name for source in find_sources(folder)] == ["a.mp4", "c/0.mp4"]

    def test_a_division_is_known_whatever_its_spelling(self, folder):
        for name in ("Training/a.mp4", "VAL/a.mp4", "VAL/b.mp4"):
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).touch()
        sides = {source.name: source.split for source in find_sources(folder)}
        assert sides == {"Training/a.mp4": "train", "VAL/a.mp4": "eval", "VAL/b.mp4": "eval"}

    def test_frames_beside_a_video_are_not_dropped(self, folder):
        for i in range(5):
            (folder / f"{i}.png").touch()
        (folder / "preview.mp4").touch()
        with pytest.raises(ValueError, match=r"holds 5 images beside preview\.mp4"):
            find_sources(folder)

    def test_one_group_leaves_a_side_empty(self, folder):
        write_video(folder / "movie" / "1.mp4"), write_video(folder / "movie" / "2.mp4", 1)
        with pytest.raises(ValueError, match=r"2 clips.*one group, 'movie'.*add another video"):
            load_backgrounds(folder)

    def test_an_empty_side(self, folder):
        (folder / "eval").mkdir()
        write_video(folder / "train" / "1.mp4")
        with pytest.raises(ValueError, match="eval side of the split has no clips"):
            load_backgrounds(folder)

    def test_the_same_content_on_both_sides(self, folder):
        write_frames(folder / "a"), write_frames(folder / "b")
        with pytest.raises(ValueError, match=r"[ab] \(train\) and .*[ab] \(eval\) have the same content; remove one"):
            load_backgrounds(folder)


class TestMistakes:
    def test_missing_folder_and_file_instead_of_folder(self, folder):
        with pytest.raises(ValueError, match=r"videos.nothing does not exist.*correct the path"):
            load_backgrounds(folder / "nothing")
        with pytest.raises(ValueError, match=r"a\.mp4 is a file; give the folder"):
            load_backgrounds(write_video(folder / "a.mp4"))

    def test_no_videos_says_what_was_found(self, folder):
        with pytest.raises(ValueError, match="found an empty folder"):
            load_backgrounds(folder)
        for name in ("a.txt", "b.txt", "c.zip", "d"):
            (folder / name).touch()
        with pytest.raises(ValueError, match=r"no videos in .*2 x \.txt, 1 x .*; put video files \(.*\.mp4"):
            load_backgrounds(folder)


def test_natural_key():
    names = ["f10.png", "F9.png", "f1b.png", "f1.png", "10.png", "9.png"]
    assert sorted(names, key=natural_key) == ["9.png", "10.png", "f1.png", "f1b.png", "F9.png", "f10.png"]
