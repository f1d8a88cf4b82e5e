"""The field's words, once, everywhere: in code, messages, log keys, hyperparameters and prose.

Readers come from Stable-Baselines3, Gymnasium, torchvision, PEFT and Hugging Face, and must not have to translate.
Names inside files that were written before a name changed are mapped in ``sb3_abisim/common/vocabulary.py`` alone.
"""

import json
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Where old names have their place: what maps them, this file, and the history of changes.
EXEMPT = {
    "CHANGELOG.md",
    "sb3_abisim/common/vocabulary.py",
    "tests/common/test_vocabulary.py",
    "tests/test_words.py",
    # They write files as they were before names changed, and datasets key by key.
    "tests/data/test_dataset.py",
    "tests/dataset_inputs.py",
    "tests/envs/scan_nav/test_map.py",
    "tests/networks/test_encoder_file.py",
    "tests/pretraining/test_card.py",
    "tests/pretraining/test_checkpoint.py",
    "tests/pretraining/test_config.py",
}
# Committed results keep what they were written with, and licenses are quoted.
LEFT_OUT = ("benchmarks/results/comparison/", "sb3_abisim/media/LICENSES-media.md")
SUFFIXES = {".py", ".md", ".yml", ".cfg", ".toml", ".html", ".css", ".ipynb", ""}

# Pattern: what to write instead. Without regard to case.
WORDS = {
    # Observations.
    r"pictures?": "observation (image observation, frame of a video, figure)",
    r"recolou?r\w*": "color jitter, color_jitter=",
    r"in looks": "color jitter",
    # Training and evaluation.
    r"trained along": "fine-tuned",
    r"most likely (actions?|ones?)": "the deterministic policy",
    r"sampled actions?": "the stochastic policy",
    r"half of the way|half way (from|to)": "50 % normalized return",
    r"held[- ]out|holdouts?|part=": "the eval split, split=, eval_fraction",
    r"lockstep": "batched VecEnv",
    r"fused?|fusing": "merge",
    r"films?|filmed": "record, recording",
    # One word for a sha256.
    r"fingerprints?|checksums?": "hash",
    # Pretraining.
    r"run_length|runs of transitions": "chunk, chunk_length",
    r"at_both_ends": "split_pair",
    r"change_weight": "delta_scale",
    r"above_chance": "chance_corrected",
    r"near pairs": "nearest-neighbor pairs",
    r"drifts?": "relative weight change",
    r"golden( batch)?": "reference batch",
    r"held against": "compared with",
    r"flats": "apartments",
    r"test/(accuracy|loss|metric|prediction|contrast)": "eval/*",
    r"time/n_updates": "train/n_updates",
    # American spelling, as in those libraries.
    r"\w*(colour|neighbour|behaviour|favour|flavour|honour)\w*": "color, neighbor, behavior, ...",
    r"\w*(normalis|initialis|optimis|quantis|vectoris|regularis|minimis|maximis|rasteris|standardis)\w*": "-iz-",
    r"(grey|greys|centre|centres|centred|metres?|\w+metres|learnt|licences?|labelled|artefacts?)": "American spelling",
}
# What a pattern may match where the word is somebody else's, or a key of a file's format.
ALLOWED = {
    r"fingerprints?|checksums?": r'_KEY = "digest", "checksum", "fingerprint"|\(`digest`\).*\(`checksum`\)',
    r"golden( batch)?": r'"golden\.|``golden\.',
    # The text that is hashed into a dataset's identity.
    r"in looks": r'\{plain\} in looks"',
}


def files() -> list[str]:
    command = ["git", "ls-files", "-co", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [
        name
        for name in names
        if Path(name).suffix in SUFFIXES
        and name not in EXEMPT
        and not name.startswith(LEFT_OUT)
        and (ROOT / name).is_file()
    ]


def lines_of(name: str) -> list[str]:
    text = (ROOT / name).read_text(encoding="utf-8", errors="replace")
    if name.endswith(".ipynb"):
        # What was written, not the figures that came out.
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    return text.splitlines()


TEXTS = {name: lines_of(name) for name in files()}


@pytest.mark.parametrize("pattern", WORDS)
def test_the_fields_word(pattern: str) -> None:
    word = re.compile(rf"(?<![A-Za-z0-9-])(?:{pattern})(?![A-Za-z0-9])", re.IGNORECASE)
    allowed = re.compile(ALLOWED[pattern]) if pattern in ALLOWED else None
    found = [
        f"{name}:{number}: {line.strip()[:120]}"
        for name, lines in TEXTS.items()
        for number, line in enumerate(lines, 1)
        if word.search(line) and not (allowed and allowed.search(line))
    ]
    assert not found, f"write {WORDS[pattern]} in\n" + "\n".join(found[:40])


@pytest.mark.parametrize("room", ["sb3_abisim/benchmark/", "docs/benchmark.md", "tests/benchmark/"])
def test_a_benchmark_has_jobs(room: str) -> None:
    word = re.compile(r"\b(cells?|CellError|markers?(?!=)|proof|units)\b")
    found = [
        f"{n}:{i}: {line}"
        for n, lines in TEXTS.items()
        if n.startswith(room)
        for i, line in enumerate(lines, 1)
        if word.search(line)
    ]
    assert not found, "write job, manifest, output file, cost in\n" + "\n".join(found[:40])


def test_digest_is_hashlibs_word_alone() -> None:
    word = re.compile(r"\bdigests?\b(?!\()")
    place = re.compile(r'"digest"|``?digest``?|_digest"|hashlib\.file_digest')
    found = [
        f"{n}:{i}: {line}"
        for n, lines in TEXTS.items()
        for i, line in enumerate(lines, 1)
        if word.search(line) and not place.search(line)
    ]
    assert not found, "write hash in\n" + "\n".join(found[:40])
