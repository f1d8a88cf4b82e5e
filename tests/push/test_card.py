"""The card, read with huggingface_hub's own classes; and its evidence."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from benchmark_inputs import STEPS, write_run
from extractor_inputs import write
from huggingface_hub import ModelCard
from huggingface_hub.repocard_data import model_index_to_eval_results
from markdown import markdown

from sb3_abisim.benchmark.report import statistics
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.push.card import make_card
from sb3_abisim.push.evidence import benchmark_evidence, probes_evidence
from sb3_abisim.push.markdown import code_block, inert
from sb3_abisim.push.upload import repository

HOSTILE = "<script>alert(1)</script> [x](http://evil) *b* | `c` \x1b[2J\n# heading"


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    # Ratios of steps are no part of a card.
    monkeypatch.setattr(statistics, "N_RESAMPLES", 20)


@pytest.fixture
def file(tmp_path: Path) -> EncoderFile:
    return load_encoder(write(tmp_path / "mine.safetensors"))


def write_runs(folder: Path, hash: str, last: float = -20.0) -> Path:
    """Two seeds of a method whose first used the encoder, and two of another."""
    for method in ("abisim", "ssi"):
        for seed in range(2):
            returns = np.linspace(-100, last - seed, len(STEPS))[:, None] + np.zeros((1, 4))
            final = {"deterministic/standard": returns[-1], "stochastic/standard": returns[-1] + 4}
            run = write_run(folder, "PointMaze-v0", method, seed, STEPS, returns, final=final)
            path = run / "PointMaze-v0" / "method.json"
            if method == "abisim" and seed == 0:
                path.write_text(json.dumps({**json.loads(path.read_text()), "encoder_hash": hash}))
    return folder


def write_probes(path: Path, hash: str, **more: Any) -> Path:
    scores = {"eval layouts": {"agent": {"linear": 0.75, "MLP": None}, HOSTILE: {"linear": 0.5, "MLP": 0.25}}}
    other = {"eval layouts": {"agent": {"linear": 0.125, "MLP": 0.125}}}
    encoders = {"a": {"hash": None, "scores": other}, "b": {"hash": hash, "scores": scores}}
    path.write_text(json.dumps({"env_id": "Nav2D-v0", "encoders": encoders, **more}))
    return path


def test_huggingface_reads_the_card(file: EncoderFile, tmp_path: Path) -> None:
    runs, probes = write_runs(tmp_path / "runs", file.hash), write_probes(tmp_path / "p.json", file.hash)
    files = repository(str(file.path), "me/enc", "mit", str(runs), str(probes))
    card = ModelCard(files["README.md"].decode())
    data = card.data.to_dict()
    assert (data["library_name"], data["license"], data["pipeline_tag"]) == (
        "stable-baselines3", "mit", "reinforcement-learning",
    )  # fmt: skip
    assert {"abisim", "Nav2D-v0", "sb3_abisim", "reinforcement-learning"} <= set(data["tags"])
    name, results = model_index_to_eval_results(data["model-index"])
    assert name == "enc"
    found = {(result.dataset_name, result.metric_name): result for result in results}
    returns = found["PointMaze-v0, standard", "mean return of abisim, deterministic policy"]
    # -20 and -21; Student's t of one degree of freedom, 12.706, times 0.5.
    assert returns.metric_value == -20.5 and returns.metric_type == "mean_reward" and returns.verified is False
    assert returns.metric_args["half_width_of_95_percent_interval"] == pytest.approx(12.706 / 2, abs=1e-3)
    assert returns.metric_args["n_runs"] == 2
    assert found["PointMaze-v0, standard", "mean return of abisim, stochastic policy"].metric_value == -16.5
    assert found["Nav2D-v0, eval layouts", "agent, linear probe"].metric_value == 0.75
    # Not the other method's, nor another encoder's.
    assert len(results) == 2 + 3


def test_results_of_each_split_keep_their_split(file: EncoderFile, tmp_path: Path) -> None:
    scores = {split: {"agent": {"linear": score}} for split, score in (("train clips", 0.75), ("eval clips", 0.5))}
    probes = {"env_id": "Nav2D-v0", "encoders": {"a": {"hash": file.hash, "scores": scores}}}
    (tmp_path / "p.json").write_text(json.dumps(probes))
    evidence = [probes_evidence(file, str(tmp_path / "p.json"))]
    results = ModelCard(make_card(file, "me/enc", None, evidence)).data.eval_results
    found = {result.dataset_name: (result.dataset_split, result.metric_value) for result in results}
    assert found == {
        "Nav2D-v0, train clips": ("train clips", 0.75),
        "Nav2D-v0, eval clips": ("eval clips", 0.5),
    }


def test_the_text_says_how_to_use_it_and_what_it_gained(file: EncoderFile, tmp_path: Path) -> None:
    runs, probes = write_runs(tmp_path / "runs", file.hash), write_probes(tmp_path / "p.json", file.hash)
    evidence = [benchmark_evidence(file, str(runs)), probes_evidence(file, str(probes))]
    text = make_card(file, "me/enc", None, evidence)
    assert 'sb3_abisim.policy_kwargs("hf://me/enc", freeze=False)' in text
    assert "sb3-abisim train --algo ppo --env Nav2D-v0 --conf-file abisim=hf://me/enc\n" in text
    assert "| PointMaze-v0 | **abisim** | deterministic, standard | -20.50 ± 6.35 | 2 | 2 |" in text
    assert "| PointMaze-v0 | ssi | deterministic, standard | -20.50 ± 6.35 | 2 | 2 |" in text
    # The curve of this encoder's method alone, from its start to its end.
    assert "| PointMaze-v0 | abisim | 1000 | -100.00 ± 0.00 |" in text
    assert "| PointMaze-v0 | abisim | 10000 | -20.50 ± 6.35 |" in text and "| ssi | 1000 |" not in text
    # The command of the run with this file, not of the other seed.
    assert "sb3-abisim train --seed 0\n" in text and "--seed 1\n" not in text
    assert "| eval layouts | agent | linear | 0.750 |" in text and "| agent | MLP |" not in text
    assert "None were given when this was uploaded." not in text
    assert "None were given when this was uploaded." in make_card(file, "me/enc", None, [])
    assert "there was no model card beside the file" in text


def test_one_run_has_no_interval(file: EncoderFile, tmp_path: Path) -> None:
    runs = write_runs(tmp_path / "runs", file.hash)
    for run in (runs / "ppo").glob("*_2"):
        run.rename(tmp_path / run.name)
    for run in (runs / "ppo").glob("*_4"):
        run.rename(tmp_path / run.name)
    evidence = benchmark_evidence(file, str(runs))
    text = make_card(file, "me/enc", None, [evidence])
    assert "| -20.00, no interval | 1 | 1 |" in text and "nan" not in text.lower()
    assert {result.half_width for result in evidence.results} == {None}
    assert ModelCard(text).data.eval_results[0].metric_args == {"n_runs": 1}


def test_the_log_and_the_commands_of_pretraining(tmp_path: Path) -> None:
    source = load_encoder("Nav2D-v0/ssi")
    path = tmp_path / "mine.safetensors"
    path.write_bytes(source.path.read_bytes())
    card = json.loads(source.path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card))
    text = make_card(load_encoder(path), "me/enc", None, [])
    assert "sb3-abisim collect --env Nav2D-v0" in text and "| n\\_updates | 500 |" in text
    assert "BASE" not in text
    above = make_card(load_encoder("Nav2D-v0/abisim"), "me/enc", None, [])
    assert "--base BASE" in above and f"BASE is the encoder with the hash {source.hash}." in above
    other = {**card, "settings": {**card["settings"], "seed": 99}}
    for wrong, message in ((other, "is not of"), ({**card, "commands": None}, "is damaged")):
        path.with_suffix(".json").write_text(json.dumps(wrong))
        with pytest.raises(ValueError, match=message):
            make_card(load_encoder(path), "me/enc", None, [])


def test_evidence_of_another_encoder_is_refused(file: EncoderFile, tmp_path: Path) -> None:
    runs = write_runs(tmp_path / "runs", "1" * 64)
    with pytest.raises(ValueError, match=rf"no run in .*runs used .*mine.safetensors \({file.hash}\)"):
        benchmark_evidence(file, str(runs))
    with pytest.raises(ValueError, match=f"has no probes of .*{file.hash}.*; run sb3-abisim analyze probes on it"):
        probes_evidence(file, str(write_probes(tmp_path / "p.json", "1" * 64)))
    for text in ("[]", "{", '{"env_id": "a"}', '{"env_id": "a", "encoders": {"a": 1}}', "[" * 100_000):
        (tmp_path / "p.json").write_text(text)
        with pytest.raises(ValueError, match=r"p.json is not the JSON of sb3-abisim analyze probes"):
            probes_evidence(file, str(tmp_path / "p.json"))


def test_texts_of_files_do_nothing_on_the_page(file: EncoderFile, tmp_path: Path) -> None:
    probes = write_probes(tmp_path / "p.json", file.hash, env_id=HOSTILE)
    hostile = EncoderFile(
        file.path, file.hash, file.encoder, {**file.metadata, "env_id": HOSTILE, "objective": HOSTILE}
    )
    text = make_card(hostile, "me/enc", None, [probes_evidence(hostile, str(probes))])
    assert "\x1b" not in text
    head, _, body = text.removeprefix("---\n").partition("\n---\n")
    assert yaml.safe_load(head)["tags"][-1].startswith("<script>")
    html = markdown(body, extensions=["tables", "fenced_code"])
    assert "<script" not in html and 'href="http://evil' not in html and "<em>b" not in html
    assert html.count("<h1") == 1 and html.count("<h2") == 4
    # In the front matter it is within quotes.
    assert "\n# heading" not in text


def test_markdown() -> None:
    assert markdown(inert("a <b> & *c* _d_ `e` [f](g) # h \\ ~~i~~ |")) == (
        "<p>a &lt;b&gt; &amp; *c* _d_ `e` [f](g) # h \\ ~~i~~ |</p>".replace("~", "\\~").replace("\\\\~", "\\~")
    ).replace("|", "\\|")
    assert "http://" not in inert("http://a.b") and "www.a" not in inert("www.a.b") and "a@b" not in inert("a@b.c")
    assert code_block("x", ["a```b", "c\nd"]) == ["````x", "a```b", "c\\nd", "````", ""]
    assert code_block("", []) == ["```", "```", ""]
