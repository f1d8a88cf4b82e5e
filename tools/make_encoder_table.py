"""Write ``encoders/README.md`` from the cards of the shipped encoders: ``python tools/make_encoder_table.py``."""

import argparse
import json
from pathlib import Path

ENCODERS = Path(__file__).parent.parent / "encoders"
HEAD = """# Shipped encoders

Pretrained with the settings of `hyperparams/pretrain/` on uniformly random actions, seed 0, one thread. The card beside
each file (`.json`) holds the commands that made it, the digest of its data, all curves and the settings. This table is
made of the cards by `tools/make_encoder_table.py`; its numbers are those of the last row of the log, on held-out
episodes.

* `accuracy` of `ssi` and `acro`: share of actions told from two pictures one or k steps apart (for continuous actions,
  the coefficient of determination). A blocked move looks like any other blocked move, so 1 cannot be reached.
* `accuracy` of `info_nce`: share of actions ranked first, among all four or, continuous, among those of a batch of 256.
* `accuracy` of `curl`: share of keys found in a batch of 256.
* `squared_error` of `beta_vae`: of the reconstruction, per intensity in 0..1; `kl` is in nats per picture.
* `metric` and `distance` of `abisim`: the loss (mean squared difference between distance and target, sampling noise of
  the target included; with `pairs: near` relative to the base distance, as trained), the mean distance it belongs to.

| encoder | transitions | updates | parameters | features | kB | held-out result |
|---|---:|---:|---:|---:|---:|---|
"""

RESULTS = {"beta_vae": ("squared_error", "kl"), "abisim": ("metric", "distance")}


def main() -> None:
    """Write the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    rows = []
    for path in sorted(ENCODERS.glob("*/*.json")):
        card = json.loads(path.read_text())
        names = RESULTS.get(card["settings"]["objective"], ("accuracy",))
        result = ", ".join(f"{name} {card['metrics'][f'test/{name}']:.3g}" for name in names)
        size = path.with_suffix(".safetensors").stat().st_size / 1000
        rows.append(
            f"| `{path.parent.name}/{path.stem}` | {card['dataset']['n_transitions']:,} | "
            f"{card['settings']['n_updates']:,} | {card['n_parameters']:,} | {card['features_dim']} | {size:.0f} | "
            f"{result} |"
        )
    (ENCODERS / "README.md").write_text(HEAD + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
