"""The one command: ``sb3-abisim COMMAND ...``, the same as ``python -m sb3_abisim COMMAND ...``."""

import difflib
import importlib
import sys
from collections.abc import Sequence
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import PROGRAM

# Command: the module whose ``main`` runs it, and what it does.
COMMANDS = {
    "collect": ("sb3_abisim.data.collect", "collect transitions of an environment into a dataset"),
    "data": (
        "sb3_abisim.data.command",
        "import a dataset from another format, export one to Minari, or show what is in one",
    ),
    "pretrain": ("sb3_abisim.pretraining.pretrain", "pretrain an encoder on a dataset"),
    "train": ("sb3_abisim.zoo.command", "train an agent: rl-zoo3's train with our methods for --conf-file"),
    "enjoy": ("sb3_abisim.zoo.command", "watch a trained agent: rl-zoo3's enjoy"),
    "record": ("sb3_abisim.zoo.record", "record the agent that a run ended with as a GIF"),
    "merge": ("sb3_abisim.zoo.merge", "put a frozen encoder into the model that was trained on its embeddings"),
    "export": ("sb3_abisim.networks.export", "write an encoder as ONNX or a torch.export program"),
    "push": ("sb3_abisim.push.upload", "upload an encoder with its card to the Hugging Face Hub"),
    "analyze": ("sb3_abisim.analysis.command", "show what an encoder sees: figures and numbers"),
    "benchmark": ("sb3_abisim.benchmark.command", "compare methods over environments and seeds, and report"),
    "zoo": ("sb3_abisim.zoo.command", "any other command of rl-zoo3, such as record_video or all_plots"),
    "doctor": ("sb3_abisim.doctor", "say what is installed, or what is inside a file and whether it loads here"),
    "demo": ("sb3_abisim.demo", "the whole way in three minutes: collect, pretrain, train, record"),
}


def usage() -> str:
    """What ``--help`` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND ...",
            "",
            "Encoders for Stable-Baselines3, pretrained without rewards.",
            "",
            *lines,
            "",
            f"{PROGRAM} COMMAND --help says more; {PROGRAM} --version says which version this is.",
            f"example: {PROGRAM} collect --env PointMaze-v0 -n 200000 -o data/pointmaze",
        ]
    )


def _preprocessing_entry(env_id: str, conf_file: str | None) -> dict[str, Any]:
    """See :mod:`sb3_abisim.zoo.collect`; ids of this package need no rl-zoo3, which takes seconds to import."""
    from sb3_abisim.envs import ENV_IDS

    if conf_file is None and env_id in ENV_IDS:
        return {}
    from sb3_abisim.zoo.collect import preprocessing_entry

    return preprocessing_entry(env_id, conf_file)


def _model_policy(name: str, epsilon: float, trust: bool) -> Any:
    from sb3_abisim.zoo.collect import model_policy

    return model_policy(name, epsilon, trust)


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command; exits with 2 for an unknown one.

    :param argv: the command and its words; None for those of the process
    """
    words = sys.argv[1:] if argv is None else list(argv)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return
    if words[0] == "--version":
        print(f"{PROGRAM} {__version__}")
        return
    if words[0] not in COMMANDS:
        close = difflib.get_close_matches(words[0], COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(COMMANDS)}"
        print(f"{PROGRAM}: error: unknown command {words[0]!r}; {hint}", file=sys.stderr)
        sys.exit(2)
    module = importlib.import_module(COMMANDS[words[0]][0])
    if words[0] == "collect":
        module.main(words[1:], _preprocessing_entry, _model_policy)
        return
    # rl-zoo3's commands share a module, which needs the name.
    module.main(words if module.__name__.startswith("sb3_abisim.zoo.command") else words[1:])


if __name__ == "__main__":
    main()
