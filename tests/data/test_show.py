"""``data show``: what the page says, and that texts of others do nothing on it."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from gymnasium import spaces

from sb3_abisim.data import chains as module_of_chains
from sb3_abisim.data import command, summary
from sb3_abisim.data import show as module
from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, TERMINATED
from sb3_abisim.data.show import render, show
from sb3_abisim.data.summary import Episodes, action_parts, chart_of, episodes_of, factor_parts, find_duplicates, spread

HOSTILE = "<script>alert(1)</script>\x1b[2J\"'><img src=x onerror=alert(2)>"


gym.register("PlainLong-v0", entry_point=index_env.PlainEnv, max_episode_steps=23)


class Page(HTMLParser):
    """Tags with their attributes, and the words between them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def grids(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("show") / "nav2d"
    collect("Nav2D-v0", 2000, folder, n_envs=8)
    return folder


@pytest.fixture(scope="module")
def chains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes that go on from shard to shard."""
    folder = tmp_path_factory.mktemp("show") / "plain"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module_of_chains, "CHAINED_SHARD_TRANSITIONS", 12)
        collect("PlainLong-v0", 150, folder, n_envs=3, seed=2)
    return folder


def test_the_page_needs_no_other_file(grids: Path, tmp_path: Path) -> None:
    page = Page(show(grids, tmp_path / "new" / "a.html").read_text())
    sources = [attributes["src"] or "" for tag, attributes in page.tags if tag == "img"]
    assert len(sources) == 8 * 10 and all(source.startswith("data:image/png;base64,") for source in sources)
    assert not [tag for tag, attributes in page.tags if tag in ("script", "link") or "href" in attributes]
    for title in ("Episodes", "Lengths", "Actions", "Coverage", "Duplicates", "Leaks"):
        assert title in page.text
    assert "2,000 transitions of Nav2D-v0" in page.text
    assert "Collected by the policy uniform, seed 0, 8 copies." in page.text
    assert "sb3-abisim analyze leak --data" in page.text
    assert any(attributes.get("name") == "viewport" for tag, attributes in page.tags if tag == "meta")


def test_the_same_dataset_gives_the_same_page(grids: Path, tmp_path: Path) -> None:
    assert show(grids, tmp_path / "a.html").read_bytes() == show(grids, tmp_path / "b.html").read_bytes()


def test_it_looks_like_a_report() -> None:
    """One style sheet, for phones and paper, too."""
    from importlib import resources

    own = [
        resources.files("sb3_abisim.data") / "show.html",
        resources.files("sb3_abisim.benchmark.report") / "page.html",
    ]
    for path in own:
        text = path.read_text()
        assert text.startswith('{% extends "base.html" %}') and "<style" not in text
    base = (resources.files("sb3_abisim.common") / "page.html").read_text()
    assert "@media print" in base and "@media (max-width" in base


def test_episodes_go_on_from_shard_to_shard(chains: Path) -> None:
    dataset = TransitionDataset(chains)
    episodes = episodes_of(dataset)
    assert any(len(parts) > 1 for parts in episodes.segments)
    assert episodes.n_steps.sum() == dataset.n_transitions
    first, last, _ = dataset.segments()
    assert sorted(part for parts in episodes.segments for part in parts) == list(
        zip(first.tolist(), last.tolist(), strict=True)
    )
    numbers = dataset.frames(np.arange(dataset.n_frames)).reshape(dataset.n_frames, -1)
    for k, n in enumerate(episodes.n_steps):
        frames = episodes.frames(k)
        assert len(frames) == n + 1
        for one, other in zip(episodes.segments[k], episodes.segments[k][1:], strict=False):
            # Where a shard ends, its last observation is the next one's first.
            assert (numbers[one[1]] == numbers[other[0]]).all()
    assert episodes.frames(0)[0] == 0


def test_actions_of_every_space() -> None:
    class Data:
        def __init__(self, space: gym.Space[Any], actions: Any) -> None:
            self.action_space, self._actions = space, np.array(actions)

        def actions(self, index: Any) -> Any:
            return self._actions[index]

    def parts(space: gym.Space[Any], actions: Any) -> list[dict[str, Any]]:
        return action_parts(Data(space, actions), np.arange(len(actions)))  # type: ignore[arg-type]

    (choice,) = parts(spaces.Discrete(3, start=5), [5, 5, 5, 7])
    assert choice["rows"] == [
        {"label": "5", "share": 0.75}, {"label": "6", "share": 0.0}, {"label": "7", "share": 0.25},
    ]  # fmt: skip
    first, second = parts(spaces.MultiDiscrete([2, 3]), [[0, 2], [1, 2]])
    assert [row["share"] for row in first["rows"]] == [0.5, 0.5]
    assert [row["share"] for row in second["rows"]] == [0.0, 0.0, 1.0]
    assert [len(part["rows"]) for part in parts(spaces.MultiBinary(3), [[0, 1, 1]])] == [2, 2, 2]
    low, high = parts(spaces.Box(np.array([-2, 0], np.float32), np.array([2, 8], np.float32)), [[-2, 8], [-2, 0]])
    assert (low["chart"].low, low["chart"].high, high["chart"].high) == ("-2", "2", "8")
    assert low["chart"].shares == [1.0] + [0.0] * 19 and high["chart"].shares == [1.0] + [0.0] * 18 + [1.0]
    # Too many for a bar each.
    assert parts(spaces.Discrete(100), [0, 99])[0]["chart"].high == "99"


def test_charts() -> None:
    chart = chart_of(np.array([0, 0, 1]))
    assert chart is not None and chart.shares[0] == 1.0 and chart.shares[-1] == 0.5
    constant = chart_of(np.array([3.0, 3.0]))
    assert constant is not None and (constant.low, constant.high) == ("3", "3")
    assert chart_of(np.array([])) is None and chart_of(np.array([np.nan])) is None


def test_coverage(grids: Path) -> None:
    dataset = TransitionDataset(grids)
    index = np.arange(200)
    found = {part["name"]: part for part in factor_parts(dataset, index)}
    assert found.keys() == dataset.meta["factors"].keys()
    agents = dataset.factors(index)["agent"]
    part = found["agent"]
    assert part["shape"] == "2" and part["n_distinct"] == len(np.unique(agents, axis=0))
    assert part["low"] == f"{agents.min()}" and part["high"] == f"{agents.max()}"
    assert len(part["map"]["cells"]) == part["n_distinct"] and part["map"]["size"] == np.ptp(agents, axis=0).max() + 1
    # What never varies needs no map.
    (same,) = (part for part in factor_parts(dataset, index[:1]) if part["name"] == "agent")
    assert (same["n_distinct"], same["map"]) == (1, None)
    assert part["map"]["visited"] == part["n_distinct"] / part["map"]["size"] ** 2


class Blocks:
    """Frames 0 0 | 1 2 | 1 2 | 3 4: the first episode changes nothing, the next two are equal."""

    observation_space = spaces.Box(0, 255, (1, 1, 1), np.uint8)
    _frames = np.array([0, 0, 1, 2, 1, 2, 3, 4], np.uint8).reshape(8, 1, 1, 1)
    _actions = np.array([0, 0, 1, 0, 1, 0, 1, 0])

    def frames(self, index: Any) -> Any:
        return self._frames[index]

    def actions(self, index: Any) -> Any:
        return self._actions[index]


def test_duplicates(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = np.full(4, TERMINATED, np.uint8)
    episodes = Episodes([[(0, 1)], [(2, 3)], [(4, 5)], [(6, 7)]], np.ones(4, np.int64), ends)
    for chunk in (1, 2**20):
        monkeypatch.setattr(summary, "CHUNK_BYTES", chunk)
        found = find_duplicates(Blocks(), episodes, np.array([0, 2, 4, 6]))  # type: ignore[arg-type]
        assert (found.n_frames, found.n_distinct, found.repeated, found.unchanged) == (4, 3, 0.5, 0.25)
        assert (found.n_episodes, found.equal_episodes) == (4, 0.5)
    cut = Episodes(episodes.segments, episodes.n_steps, np.array([TERMINATED, CUT, TERMINATED, TERMINATED], np.uint8))
    found = find_duplicates(Blocks(), cut, np.array([0, 2]))  # type: ignore[arg-type]
    assert (found.n_episodes, found.equal_episodes) == (3, 0.0)
    other = Blocks()
    other._actions = np.array([0, 0, 1, 0, 2, 0, 1, 0])
    assert find_duplicates(other, episodes, np.array([0])).equal_episodes == 0.0  # type: ignore[arg-type]


def test_a_large_dataset_is_sampled(grids: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("MAX_FRAMES", 64), ("MAX_ACTIONS", 100)):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(summary, "MAX_EPISODES", 5)
    monkeypatch.setattr(summary, "MAX_FACTOR_BYTES", 1)
    most, read = [0], TransitionDataset.frames

    def frames(self: TransitionDataset, index: Any) -> Any:
        most[0] += len(index)
        return read(self, index)

    monkeypatch.setattr(TransitionDataset, "frames", frames)
    text = Page(render(TransitionDataset(grids))).text
    # Both ends of transitions, the first ones of episodes, and the strips.
    assert most[0] <= 2 * 64 + 5 + 8 * 10
    assert "Of 64 observations, 64 transitions and 5 whole episodes." in text and "Of 100 of 2,000 actions." in text
    assert len(spread(np.arange(100), 7)) == 7 and spread(np.arange(5), 7).tolist() == [0, 1, 2, 3, 4]


def test_what_makes_data_useless_is_said(grids: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = TransitionDataset(grids)
    assert "Before you pretrain on it" not in Page(render(dataset)).text
    dataset._actions = np.minimum(dataset._actions, 2)
    assert "Of the action, 3 never occurs in the sample." in Page(render(dataset)).text
    monkeypatch.setattr(TransitionDataset, "frames", lambda self, index: np.zeros((len(index), 3, 15, 15), np.uint8))
    text = Page(render(dataset)).text
    assert "Only 1 of 2,000 observations are distinct." in text and "100.0 % of the transitions change nothing" in text


def test_texts_of_others_do_nothing(grids: Path, tmp_path: Path) -> None:
    folder = tmp_path / "<img src=x onerror=alert(3)>&"
    shutil.copytree(grids, folder)
    dataset = TransitionDataset(folder)
    dataset.env_id, dataset.env_kwargs = HOSTILE, {HOSTILE: HOSTILE}
    dataset.hash, dataset.preprocessing = HOSTILE, {"env_wrapper": HOSTILE}
    for change in ({"source": HOSTILE}, {"source": None, "policy": HOSTILE}):
        dataset.meta = {**dataset.meta, **change}
        text = render(dataset)
        page = Page(text)
        assert "\x1b" not in text and "<script" not in text and "<img src=x" not in text
        assert not [tag for tag, attributes in page.tags if tag == "script" or "onerror" in attributes]
        assert "alert(1)" in page.text and "alert(3)" in page.text


def write_leak(path: Path, hash: Any, **more: Any) -> Path:
    audit = {"scores": [[0.75, 0.0], [-0.1, 0.25], [0.0, 0.0]], "best": [0, 0], "patch": [3, 3], "leaks": True}
    numbers = {"figure": "leak", "n_transitions": 1234, "threshold": 0.5, "dataset_hash": hash,
               "audits": {"as it is": audit}, **more}  # fmt: skip
    path.write_text(json.dumps(numbers))
    return path


def test_an_audit_of_leaks_is_shown(grids: Path, tmp_path: Path) -> None:
    leak = write_leak(tmp_path / "leak.json", TransitionDataset(grids).hash)
    text = Page(show(grids, tmp_path / "a.html", leak).read_text()).text
    assert "The highest score of a patch is 0.75 of 1, above 0.5" in text and "(1,234 transitions)" in text
    assert "A few pixels show the action" in text and "Not audited." not in text
    with pytest.raises(ValueError, match=r"is not an audit of .*nav2d; make one with sb3-abisim analyze leak --data"):
        show(grids, tmp_path / "b.html", write_leak(tmp_path / "leak.json", "1" * 64))
    for more in ({"figure": "probes"}, {"audits": {}}, {"audits": {"as it is": {"scores": [[None]], "leaks": False}}}):
        with pytest.raises(ValueError, match="is not the JSON of sb3-abisim analyze leak"):
            show(grids, tmp_path / "b.html", write_leak(tmp_path / "leak.json", "1" * 64, **more))
    assert not (tmp_path / "b.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent", "-o", "a.html"], "absent is not a folder"),
        (["nav2d", "-o", "a.png"], "the page must end in .html, got a.png"),
        (["nav2d", "-o", "a.html", "--leak", "absent.json"], "No such file or directory: 'absent.json'"),
    ],
)
def test_mistakes_are_one_line(
    words: list[str], message: str, grids: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(grids, "nav2d")
    with pytest.raises(SystemExit) as stop:
        command.main(["show", *words])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and message in err and len(err.splitlines()) == 1, err
    assert not Path("a.html").exists()


def test_channels_of_any_number(grids: Path) -> None:
    for n_channels, mode in ((1, "L"), (3, "RGB"), (4, "RGB"), (2, "L"), (12, "RGB")):
        frame = np.arange(n_channels, dtype=np.uint8)[:, None, None] + np.zeros((n_channels, 20, 30), np.uint8)
        import io

        from PIL import Image

        with Image.open(io.BytesIO(module._png(frame))) as image:
            assert image.mode == mode and image.size == (90, 60), n_channels
            corner = image.getpixel((0, 0))
        assert corner == {1: 0, 3: (0, 1, 2), 4: (0, 1, 2), 2: 1, 12: (9, 10, 11)}[n_channels]
    with Image.open(io.BytesIO(module._png(np.zeros((3, 300, 600), np.uint8)))) as image:
        assert image.size == (96, 48)
