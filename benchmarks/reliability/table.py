"""The tables of the counts, and their place in docs/limits.md."""

import textwrap
from typing import Any

# What should be 0, by part: the key of a row, and what it is called.
AIMS: dict[str, dict[str, str]] = {
    "damage": {"silent": "loaded as other content", "bare": "bare exceptions"},
    "hostile": {"executed": "executions", "large": "over 1 GB", "long": "over 30 s", "bare": "bare exceptions"},
    "faults": {"lost": "lost", "orphans": "orphans", "bare": "tracebacks"},
    "steps": {"breaches": "breaches", "different": "not deterministic"},
    "nan": {"missed": "trained to the end"},
}
_COUNTED: dict[str, dict[str, str]] = {
    "damage": {"n": "damaged", "refused": "refused with a sentence", "equal": "equal content all the same"},
    "hostile": {"n": "files", "refused": "refused with a sentence", "harmless": "read, and harmless"},
    "faults": {"kills": "kills", "full": "full disks, said in a sentence"},
    "steps": {"steps": "steps", "refused": "refused: no action, or after the end"},
    "nan": {"n": "injected", "caught": "training stopped"},
}
_MEASURED: dict[str, dict[str, str]] = {"hostile": {"megabytes": "MB at most", "seconds": "s at most"}}
_TITLES = {
    "damage": (
        "Damaged files", "what is damaged",
        "A flipped bit, a missing end, two blocks exchanged and a block of zeros, in turns, at random places. What was "
        "read is compared with what was written. Caches, and a dataset that is collected again, are made anew.",
    ),
    "hostile": (
        "Files of strangers", "what is in them",
        "Each is read in a process of its own, in which started programs, connections and files written elsewhere are "
        "noted. Memory is the largest resident size, with the libraries; time is that of the processor.",
    ),
    "faults": (
        "Kills and full disks", "command",
        "`kill -9` at a random moment, and a limit on the size of files at which the system refuses to write on. The "
        "same command then has to give what it gives undisturbed, and a file that was there before is whole at any "
        "time. `train` begins a run of its own each time.",
    ),
    "steps": (
        "Random steps", "environment",
        "Nine of ten steps are in batches of 16. Observations, rewards and ends have to be what is declared. A second "
        "environment of the same seed, and copies and pickles made on the way, have to give the same. What is no "
        "action is refused, and so is a step after the end of an episode. After a truncation by the time limit of "
        "`gymnasium.make` alone, that wrapper lets steps through.",
    ),
    "nan": (
        "NaN and infinity in training", "algorithm",
        "In a reward, an observation, an action, a weight or a loss, at a random step of a short training with "
        "`EncoderCallback`.",
    ),
}  # fmt: skip
# What stands below it in docs/limits.md is written by this module.
HEADING = "## Counted\n"
_HEAD = """
`python -m benchmarks.reliability --seed 0` makes every input of these tables itself, and the tables from
[its counts](../benchmarks/results/reliability.json). A small part of it runs in every test.
"""


def tables(found: dict[str, Any]) -> str:
    """What stands below :data:`HEADING`.

    :param found: the parts by name, as the JSON file holds them
    """
    blocks = [_HEAD]
    for part, (title, first, text) in _TITLES.items():
        if part in found:
            table = _table(part, first, found[part]["rows"])
            blocks.append("\n\n".join([f"### {title}", textwrap.fill(text, 120), table, _how(found[part])]) + "\n")
    missing = [title for part, (title, _, _) in _TITLES.items() if part not in found]
    if missing:
        blocks.append(f"Not counted at this scale yet: {', '.join(missing).lower()}.\n")
    return "\n".join(blocks)


def page(before: str, found: dict[str, Any]) -> str:
    """A page with the tables of these counts in place of those that it ends with.

    :param before: the page
    :param found: as for :func:`tables`
    :raises ValueError: for a page without their heading
    """
    head, heading, _ = before.partition(HEADING)
    if not heading:
        raise ValueError(f"the page has no line {HEADING.strip()!r}, below which the tables go")
    return head + heading + tables(found)


def _how(part: dict[str, Any]) -> str:
    minutes = max(1, round(part["seconds"] / 60))
    scaled = "" if part["scale"] == 1 else f", scale {part['scale']:g}"
    # Written by hand into the file, where rows are not all of one run; a whole run leaves none.
    note = f" {part['note']}" if "note" in part else ""
    return textwrap.fill(f"Seed {part['seed']}{scaled}, {minutes} minutes of {part['machine']}.{note}", 120)


def _table(part: str, first: str, rows: dict[str, Any]) -> str:
    columns = _COUNTED[part] | AIMS[part] | _MEASURED.get(part, {})
    lines = [f"| {first} | {' | '.join(columns.values())} |", f"|---|{'---:|' * len(columns)}"]
    lines += [f"| {name} | {' | '.join(f'{row[key]:,}' for key in columns)} |" for name, row in rows.items()]
    measured = _MEASURED.get(part, {})
    totals = [f"{(max if key in measured else sum)(row[key] for row in rows.values()):,}" for key in columns]
    return "\n".join([*lines, f"| **all** | {' | '.join(f'**{total}**' for total in totals)} |"])


def breaches(found: dict[str, Any]) -> list[str]:
    """What should be 0 and is not, with examples.

    :param found: as for :func:`tables`
    """
    lines = []
    for part, aims in AIMS.items():
        for name, row in found.get(part, {"rows": {}})["rows"].items():
            wrong = [f"{row[key]} {word}" for key, word in aims.items() if row[key]]
            if wrong:
                lines.append(f"{part}, {name}: {', '.join(wrong)}; " + " | ".join(row["examples"]))
    return lines
