"""One table for a machine with a GPU: pretraining and RL, in a few minutes.

Transitions per second of pretraining for every objective: a straightforward loop (``benchmarks.bench_pretraining``),
ours in float32, with ``precision: bf16``, and both with ``torch.compile`` on encoders, which is no option of ours and
shows whether it should be one. Then steps per second of PPO and DQN, fine-tuned and on a frozen encoder
(``benchmarks.bench_frozen``). Contenders work in turns within one process. A cell is the median speed of the turns and,
in parentheses, the median and the range of its ratio to the reference in the same round. The table names the hardware.
``python -m benchmarks.gpu``; with ``--device cpu`` it takes processor time, which load disturbs less than the clock.
"""

import argparse
import functools
import platform
import shlex
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th

from benchmarks.bench_frozen import KINDS, SETTINGS, make_model
from benchmarks.bench_pretraining import BATCH_SIZE, make_run, ours, straightforward
from benchmarks.tables import write_page

RESULTS = Path(__file__).parent / "results" / "gpu.md"
ARMS = ("straightforward", "float32", "bf16", "compile", "bf16+compile")
REFERENCE = "float32"
ENV_IDS = ("Nav2D-v0", "PointMaze-v0")


def hardware(device: str) -> str:
    """What a table was measured on.

    :param device: "cuda" or "cpu"
    """
    n = th.get_num_threads()
    cpu = f"{n} {'thread' if n == 1 else 'threads'} of {platform.machine()}"
    name = th.cuda.get_device_name() if device == "cuda" else cpu
    return f"{name}, PyTorch {th.__version__}, Python {platform.python_version()}"


def objectives() -> list[str]:
    """Names of all that are registered."""
    from sb3_abisim.registry import methods

    return [name for name, method in methods().items() if method.objective is not None]


def make_arm(arm: str, objective: str, data: Path, folder: Path, device: str) -> Callable[[], Any]:
    """One contender; what it returns makes an update.

    :param arm: of ``ARMS``
    :param objective: name of a method
    :param data: a dataset's folder
    :param folder: for files that are not written
    :param device: "cuda" or "cpu"
    """
    from sb3_abisim.networks.base import Encoder
    from sb3_abisim.registry import get_method

    settings: dict[str, Any] = {"precision": "bf16"} if arm.startswith("bf16") else {}
    base = f"{data.name}/ssi" if get_method(objective).base else None
    run = make_run(objective, data, base, folder, device=device, settings=settings)
    frames = th.as_tensor(run._some_frames(256)).to(run.device)
    run.module.prepare(frames / 255.0)
    if arm.endswith("compile"):
        for part in run.module.modules():
            if isinstance(part, Encoder):
                part.layers = th.compile(part.layers)
    return functools.partial(next, straightforward(run) if arm == "straightforward" else ours(run))


def in_turns(
    contenders: dict[str, Callable[[], Any]], work: int, rounds: int, seconds: float, device: str
) -> dict[str, list[float]]:
    """Work per second of each contender in each round, after one call that does not count.

    :param contenders: by name, what is called again and again
    :param work: that one call does
    :param rounds: turns of each
    :param seconds: of a turn, at least
    :param device: "cuda" is waited for at both ends of a turn
    """
    wait = th.cuda.synchronize if device == "cuda" else (lambda: None)
    clock = time.perf_counter if device == "cuda" else time.process_time
    for call in contenders.values():
        call()
    found: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, call in contenders.items():
            wait()
            n_calls, start = 0, clock()
            while not n_calls or clock() - start < seconds:
                call()
                n_calls += 1
            wait()
            found[name].append(n_calls * work / (clock() - start))
    return found


def cells(found: dict[str, list[float]], reference: str) -> str:
    """A row: the median speed of each contender, and its ratio to the reference in the same rounds.

    :param found: of :func:`in_turns`
    :param reference: one of the contenders
    """
    row = []
    for speeds in found.values():
        ratios = [own / other for own, other in zip(speeds, found[reference], strict=True)]
        ratio = f"{statistics.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}"
        row.append(f"{statistics.median(speeds):,.0f} ({ratio})")
    return " | ".join(row)


def pretraining_rows(args: argparse.Namespace, folder: Path) -> list[str]:
    """Rows of the first table."""
    from sb3_abisim.data.collect import collect

    rows = []
    for env_id in args.env:
        data = folder / env_id
        collect(env_id, args.transitions, data, progress=False)
        for objective in args.objectives:
            contenders = {arm: make_arm(arm, objective, data, folder, args.device) for arm in args.arms}
            found = in_turns(contenders, BATCH_SIZE, args.rounds, args.seconds, args.device)
            rows.append(f"| `{objective}`, {env_id} | {cells(found, REFERENCE)} |")
            print(rows[-1], flush=True)
    return rows


def rl_rows(args: argparse.Namespace) -> list[str]:
    """Rows of the second table."""
    rows = []
    for setting in (each for each in SETTINGS if each.kinds == KINDS):
        n_steps = args.rl_steps or setting.n_steps
        models = {kind: make_model(setting, kind, args.device) for kind in KINDS}
        contenders = {
            kind: functools.partial(model.learn, n_steps, reset_num_timesteps=False) for kind, model in models.items()
        }
        # PPO fills its rollout whatever the number of steps.
        work = max(n_steps, setting.n_envs * setting.kwargs.get("n_steps", 0))
        with warnings.catch_warnings():
            # Stable-Baselines3 warns of PPO on a GPU without images; that is what is measured.
            warnings.simplefilter("ignore", UserWarning)
            found = in_turns(contenders, work, args.rounds, args.seconds, args.device)
        rows.append(f"| {setting.title} | {cells(found, KINDS[0])} |")
        print(rows[-1], flush=True)
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="(default: %(default)s)")
    parser.add_argument("--env", nargs="+", default=ENV_IDS, help="to pretrain in (default: %(default)s)")
    parser.add_argument("--objectives", nargs="+", default=objectives(), help="(default: %(default)s)")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS, help="(default: %(default)s)")
    parser.add_argument("--transitions", type=int, default=20_000, help="of each dataset (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each contender (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="of a turn (default: %(default)s)")
    parser.add_argument("--rl-steps", type=int, help="of one call of learn (default: those of a rollout or more)")
    parser.add_argument("--no-rl", action="store_true", help="leave out the second table")
    args = parser.parse_args(argv)
    if REFERENCE not in args.arms:
        parser.error(f"--arms must name {REFERENCE}, the reference")
    if args.device == "cuda" and not th.cuda.is_available():
        parser.exit(2, "python -m benchmarks.gpu: error: there is no GPU; give --device cpu\n")
    from sb3_abisim.common.malloc import keep_freed_memory

    keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        rows = pretraining_rows(args, Path(folder))
    tail: list[str] = []
    if not args.no_rl:
        tail = [f"Steps of RL per second; the reference is {KINDS[0]}:", "", "| algorithm, environment | "]
        tail[-1] += f"{' | '.join(KINDS)} |"
        tail += [f"|---|{'---:|' * len(KINDS)}", *rl_rows(args), ""]
    words = shlex.join(sys.argv[1:] if argv is None else argv)
    text = (
        f"`python -m benchmarks.gpu {words}` on {hardware(args.device)}: transitions of pretraining per second of "
        f"{'wall-clock' if args.device == 'cuda' else 'processor'} time, batches of {BATCH_SIZE}, {args.rounds} turns "
        f"of {args.seconds:g} s. In parentheses: the ratio to {REFERENCE} in the same round, median and range."
    )
    header = [f"| objective, environment | {' | '.join(args.arms)} |", f"|---|{'---:|' * len(args.arms)}"]
    write_page(args.output, "Speed on a GPU" if args.device == "cuda" else "Speed", text, header, rows, tuple(tail))


if __name__ == "__main__":
    main()
