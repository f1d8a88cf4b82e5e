"""Write ``encoders/README.md`` from the model cards of the shipped encoders: ``python tools/make_encoder_table.py``."""

import argparse
from pathlib import Path

from sb3_abisim.pretraining.card import read_card
from sb3_abisim.registry import get_method

ENCODERS = Path(__file__).parent.parent / "encoders"
HEAD = """# Shipped encoders

They were pretrained with the settings of `hyperparams/pretrain/` on uniformly random actions, with seed 0 and one
thread. The model card beside each file holds the commands that made it, the hash of its data, the settings and all
curves. Names in a card are those of the version that wrote it.

The names in the tables are what every command and `policy_kwargs` take for an encoder. `sb3-abisim doctor NAME` says
what is in a file. What an encoder holds: [docs/figures.md](../docs/figures.md). What it does for RL:
[docs/results.md](../docs/results.md). How to use one: [docs/encoders.md](../docs/encoders.md).

`tools/make_encoder_table.py` makes the tables of the cards. Results are those of the last row of the log, on the eval
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
"""
COLUMNS = """
## {env_id}

| encoder | method | transitions | updates | parameters | features | kB | result on the eval split |
|---|---|---:|---:|---:|---:|---:|---|
"""


def main() -> None:
    """Write the page."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    text = HEAD
    for folder in sorted(path for path in ENCODERS.iterdir() if path.is_dir()):
        text += COLUMNS.format(env_id=folder.name) + "".join(row(path) for path in sorted(folder.glob("*.json")))
    (ENCODERS / "README.md").write_text(text)


def row(path: Path) -> str:
    """Of the table of an environment.

    :param path: of a model card
    """
    card = read_card(path)
    method = get_method(card["settings"]["objective"])
    result = ", ".join(f"{name} {card['metrics'][f'eval/{name}']:.3g}" for name in method.results)
    size = path.with_suffix(".safetensors").stat().st_size / 1000
    name = f"{path.parent.name}/{path.stem}"
    return (
        f"| `{name}` ([card]({name}.json)) | [{method.label}](../docs/objectives/{method.name}.md) | "
        f"{card['dataset']['n_transitions']:,} | {card['settings']['n_updates']:,} | {card['n_parameters']:,} | "
        f"{card['features_dim']} | {size:.0f} | {result} |\n"
    )


if __name__ == "__main__":
    main()
