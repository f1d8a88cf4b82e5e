"""Write ``encoders/README.md`` from the cards of the shipped encoders: ``python tools/make_encoder_table.py``."""

import json
from pathlib import Path

ENCODERS = Path(__file__).parent.parent / "encoders"
HEAD = """# Shipped encoders

Pretrained with the settings of `hyperparams/pretrain/` on uniformly random actions, seed 0, one thread. The card beside
each file (`.json`) holds the commands that made it, the digest of its data, all curves and the settings. This table is
made of the cards by `tools/make_encoder_table.py`; its numbers are those of the last row of the log, on held-out
episodes.

`accuracy`: share of actions told from two consecutive pictures (for continuous actions, the coefficient of
determination). A blocked move looks like any other blocked move, so 1 cannot be reached. `metric` and `distance`: the
loss of action-bisimulation (mean squared difference between distance and target, sampling noise of the target
included; with `pairs: near` relative to the base distance, as trained) and the mean distance it belongs to.

| encoder | transitions | updates | parameters | features | kB | held-out result |
|---|---:|---:|---:|---:|---:|---|
"""


def main() -> None:
    """Write the table."""
    rows = []
    for path in sorted(ENCODERS.glob("*/*.json")):
        card = json.loads(path.read_text())
        names = ("test/accuracy",) if card["settings"]["objective"] == "ssi" else ("test/metric", "test/distance")
        result = ", ".join(f"{name.removeprefix('test/')} {card['metrics'][name]:.3g}" for name in names)
        size = path.with_suffix(".safetensors").stat().st_size / 1000
        rows.append(
            f"| `{path.parent.name}/{path.stem}` | {card['dataset']['n_transitions']:,} | "
            f"{card['settings']['n_updates']:,} | {card['n_parameters']:,} | {card['features_dim']} | {size:.0f} | "
            f"{result} |"
        )
    (ENCODERS / "README.md").write_text(HEAD + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
