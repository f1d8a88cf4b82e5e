"""Write ``encoders/README.md`` from the model cards of the shipped encoders: ``python tools/make_encoder_table.py``."""

import argparse
from pathlib import Path

from sb3_abisim.pretraining.card import read_card
from sb3_abisim.registry import get_method

ENCODERS = Path(__file__).parent.parent / "encoders"
HEAD = """# Shipped encoders

They were pretrained with the settings of `hyperparams/pretrain/` on uniformly random actions, with seed 0 and one
thread. The model card beside each file (`.json`) holds the commands that made it, the hash of its data, the settings
and all curves. Names in a card are those of the version that wrote it.

`tools/make_encoder_table.py` makes this table of the cards. Results are those of the last row of the log, on the eval
split.

* `accuracy` of `ssi` and `acro`: share of actions predicted from two observations one or k steps apart. For continuous
  actions, it is the coefficient of determination. One blocked move looks like any other, so 1 cannot be reached.
* `accuracy` of `info_nce`: share of actions ranked first, among all four or, continuous, among those of a batch of 256.
* `accuracy` of `curl`: share of keys found in a batch of 256.
* `squared_error` of `beta_vae`: of the reconstruction, per intensity in 0..1. `kl` is in nats per observation.
* `metric_loss` of `abisim`: mean squared difference between distance and target, the target's sampling noise included.
  With `pairs: nearest`, the difference is relative to the base distance, as in training. `distance` is the mean.
* `progress_r2` of `goal_progress`: coefficient of determination of the progress towards all goals. `value_loss` is the
  mean squared TD error of the values, which lie in 0..1.

| encoder | transitions | updates | parameters | features | kB | result on the eval split |
|---|---:|---:|---:|---:|---:|---|
"""


def main() -> None:
    """Write the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    rows = []
    for path in sorted(ENCODERS.glob("*/*.json")):
        card = read_card(path)
        names = get_method(card["settings"]["objective"]).results
        result = ", ".join(f"{name} {card['metrics'][f'eval/{name}']:.3g}" for name in names)
        size = path.with_suffix(".safetensors").stat().st_size / 1000
        rows.append(
            f"| `{path.parent.name}/{path.stem}` | {card['dataset']['n_transitions']:,} | "
            f"{card['settings']['n_updates']:,} | {card['n_parameters']:,} | {card['features_dim']} | {size:.0f} | "
            f"{result} |"
        )
    (ENCODERS / "README.md").write_text(HEAD + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
