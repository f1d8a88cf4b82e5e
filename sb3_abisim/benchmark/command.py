"""Compare pretraining methods: ``sb3-abisim benchmark -o DIR``, then ``sb3-abisim benchmark report DIR``."""

import argparse
import dataclasses
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_abisim.benchmark.export import add_hashes, export
from sb3_abisim.benchmark.graph import build, run_labels
from sb3_abisim.benchmark.jobs.job import Job, command_line, is_by_other_code, is_done
from sb3_abisim.benchmark.jobs.local import Engine, make_engine, run_jobs
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.common.cli import PROGRAM, add_trust, make_parser, run
from sb3_abisim.common.extras import require_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.hashes import write_hashes
from sb3_abisim.common.text import printable
from sb3_abisim.registry import methods
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.runs import INDEX_NAME, missing_runs

DEFAULT_ENV_IDS = ("Nav2D-v0", "PointMaze-v0", "DistractorPointMaze-v0")


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    Exits with 2 for mistakes in the arguments, 1 if a job failed, 130 after Ctrl-C.

    :param argv: its words; the program's arguments by default
    """
    words = sys.argv[1:] if argv is None else list(argv)
    command, rest = (words[0], words[1:]) if words and words[0] in COMMANDS else ("run", words)
    parser, function = COMMANDS[command]
    run(parser(), rest, function, "stopped; the same command goes on with the jobs that are missing")


def _run_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark",
        "Collect, pretrain, train and evaluate for every method, environment and seed; a rerun does only "
        "what is missing. Further commands, each with its --help: `benchmark report` compares the runs, `benchmark "
        "export` makes a small copy for it, `benchmark evaluate` evaluates one run's final model, `benchmark sweep` "
        "searches settings of pretraining, `benchmark hash` adds hashes to results from before.",
        "benchmark -o benchmark --env PointMaze-v0 --methods abisim ssi vanilla --seeds 0 1 2",
    )
    parser.add_argument("-o", "--output", default="benchmark", metavar="DIR", help="folder for everything")
    parser.add_argument("--methods", nargs="+", metavar="METHOD[=ENCODER][,frozen][,OPTION=VALUE]",
                        help=f"such as {', '.join(methods())}; without an encoder, it is pretrained; {{seed}} in an "
                        "encoder's name becomes the seed of pretraining (default: all but foreign)")  # fmt: skip
    parser.add_argument("--env", nargs="+", default=list(DEFAULT_ENV_IDS), metavar="ID",
                        help=f"registered ids (default: the paper's, {', '.join(DEFAULT_ENV_IDS)})")  # fmt: skip
    _add_budget(parser)
    parser.add_argument("--final-episodes", type=int, default=100,
                        help="of the final model on each split, 0 for none (default: 100)")  # fmt: skip
    parser.add_argument("--dry-run", action="store_true", help="list the jobs and their commands, and stop")
    parser.add_argument("--no-report", action="store_true", help="make no report at the end")
    return parser


def _add_budget(parser: argparse.ArgumentParser) -> None:
    """What a sweep has in common with a benchmark."""
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4], help="of RL, one run each")
    parser.add_argument("--encoder-seeds", nargs="+", type=int,
                        help="of pretraining, taken by the runs in turn (default: those of --seeds)")  # fmt: skip
    parser.add_argument("--algo", help="rl-zoo3's name (default: that of the environment, dqn for Nav2D, else ppo)")
    parser.add_argument(
        "--n-transitions", type=int, help="to pretrain on (default: as many as the environment asks for)"
    )
    parser.add_argument("-n", "--n-timesteps", type=int, help="of RL (default: that of the hyperparameters)")
    parser.add_argument(
        "--eval-freq", type=int, help="steps between evaluations (default: 16384 or n/100, the smaller)"
    )
    parser.add_argument("--eval-episodes", type=int, default=20, help="of each evaluation (default: 20)")
    parser.add_argument("--n-eval-envs", type=int, default=5, help="evaluated side by side (default: 5)")
    parser.add_argument("-params", "--params", nargs="+", default=[], metavar="[ALGO.]NAME:VALUE",
                        help="RL hyperparameters, the same for all methods")  # fmt: skip
    parser.add_argument("--pretrain-params", nargs="+", default=[], metavar="[OBJECTIVE.]NAME:VALUE",
                        help="settings of pretraining, such as abisim.objective_kwargs.c:0.9")  # fmt: skip
    parser.add_argument("--image-key", metavar="KEY",
                        help="which image of a Dict of observations to pretrain on")  # fmt: skip
    parser.add_argument("--device", default="auto", help="as in Stable-Baselines3 (default: auto)")
    parser.add_argument("--threads", type=int, default=1, help="of each job (default: 1)")
    parser.add_argument("--jobs", type=int, help="jobs at a time (default: as the processors allow)")
    parser.add_argument("--engine", default="local", choices=("local", "ray"),
                        help="where jobs run: on this machine, or on a Ray cluster (default: local)")  # fmt: skip
    parser.add_argument("--address", default="auto", help="of the Ray cluster (default: auto)")
    parser.add_argument("--gpus", type=float, default=0.0, help="per job, on Ray (default: 0)")
    parser.add_argument("--retries", type=int, default=3, help="after a lost worker, on Ray (default: 3)")


def _plan(args: argparse.Namespace, specs: list[str], env_ids: list[str], final_episodes: int) -> Plan:
    return Plan(
        methods=tuple(specs), env_ids=tuple(env_ids), seeds=tuple(args.seeds),
        encoder_seeds=tuple(args.encoder_seeds or args.seeds), algo=args.algo, n_transitions=args.n_transitions,
        n_timesteps=args.n_timesteps, eval_freq=args.eval_freq, eval_episodes=args.eval_episodes,
        n_eval_envs=args.n_eval_envs, final_episodes=final_episodes, params=tuple(args.params),
        pretrain_params=tuple(args.pretrain_params), device=args.device, threads=args.threads,
        packages=tuple(args.packages), image_key=args.image_key,
    )  # fmt: skip


def _engine(args: argparse.Namespace) -> Engine:
    ray = {"address": args.address, "gpus": args.gpus, "retries": args.retries} if args.engine == "ray" else {}
    return make_engine(args.engine, args.jobs, args.threads, **ray)


def _run(args: argparse.Namespace) -> None:
    # Nothing here pretrains the others; they need a file.
    specs = args.methods or [name for name, method in methods().items() if not method.trained_elsewhere]
    plan = _plan(args, specs, args.env, args.final_episodes)
    jobs, root = build(plan), Path(args.output)
    if args.dry_run:
        _list(root, jobs)
        return
    if not args.no_report:
        _require_report()
    errors = run_jobs(root, jobs, _engine(args))
    labels = run_labels(jobs)
    runs = [{"folder": job.output, "label": labels[job.name]} for job in jobs if job.kind == "run"]
    index = {"plan": dataclasses.asdict(plan), "runs": runs}
    write_atomic(root / INDEX_NAME, lambda file: file.write(json.dumps(index, indent=1).encode()))
    write_hashes(root, [INDEX_NAME])
    if errors:
        print(f"{len(errors)} jobs failed: {', '.join(errors)}; their logs are in {root / 'logs'}", file=sys.stderr)
        sys.exit(1)
    if not args.no_report:
        _report(_report_parser().parse_args([str(root)]))


def _list(root: Path, jobs: list[Job]) -> None:
    for job in jobs:
        state = "done" if is_done(root, job.to_json()) else "missing"
        if state == "done" and is_by_other_code(root, job.to_json()):
            state = "other code"
        print(f"{state:11}{job.name}  {job.title}\n{'':11}{command_line(job.command)}")


def _require_report() -> None:
    require_extra("benchmark", "a report", "matplotlib", "rliable", "jinja2", "scipy")


def _report_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark report",
        "Draw learning curves, tables and aggregates of zoo runs as PNG, CSV and one HTML page.",
        "benchmark report logs/ppo -o report",
    )
    parser.add_argument("folders", nargs="+", metavar="[LABEL=]FOLDER",
                        help="a benchmark's folder, or zoo log folders")  # fmt: skip
    parser.add_argument("-o", "--output", metavar="DIR", help="(default: report in the first folder)")
    parser.add_argument("--source", choices=("evaluations", "training"), default="evaluations",
                        help="learning curves from the zoo's evaluations or from the training episodes")  # fmt: skip
    parser.add_argument("--reference", help="the method that the others are compared with (default: abisim)")
    parser.add_argument("--thresholds", nargs="+", type=_threshold, metavar="NUMBER|METHOD",
                        help="normalized returns, 0 (the lowest) to 1 (the highest), or methods, for their final "
                        "return (default: 0.5 0.7 0.9, and vanilla if it is there)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    return parser


def _threshold(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _report(args: argparse.Namespace) -> None:
    _require_report()
    from sb3_abisim.benchmark.report.page import report

    page = report(args.folders, args.output, args.source, args.reference, args.thresholds, args.seed)
    print(f"report: {page}")


def _evaluate_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark evaluate",
        "Evaluate the final model of a zoo run, deterministically and stochastically, on every split.",
        "benchmark evaluate logs/ppo/PointMaze-v0_1",
    )
    parser.add_argument("folder", metavar="RUN", help="a zoo run folder")
    parser.add_argument("--episodes", type=int, default=100, help="on each split and in each mode (default: 100)")
    add_trust(parser)
    return parser


def _evaluate(args: argparse.Namespace) -> None:
    print(evaluate_final(args.folder, args.episodes, args.trust))


def _export_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark export",
        "Copy what the report reads, without models and training episodes, small enough to be committed.",
        "benchmark export benchmark -o results/benchmark",
    )
    parser.add_argument("folder", metavar="DIR", help="a benchmark's folder, or a zoo log folder")
    parser.add_argument("-o", "--output", required=True, metavar="NEW", help="the copy")
    return parser


def _export(args: argparse.Namespace) -> None:
    missing = missing_runs(args.folder)
    if missing:
        print(
            f"warning: {len(missing)} runs of {INDEX_NAME} are not there: {printable(', '.join(missing))}",
            file=sys.stderr,
        )
    print(export(args.folder, args.output))


def _hash_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark hash",
        "Write the hashes of results that have none, as runs and exports of before; a changed bit is found then. "
        "Those that are there are verified.",
        "benchmark hash results/benchmark",
    )
    parser.add_argument("folder", metavar="DIR", help="an export, a benchmark's folder, or a zoo log folder")
    return parser


def _hash(args: argparse.Namespace) -> None:
    print(f"hashes written into {add_hashes(args.folder)} folders of {args.folder}; all are as they were")


def _sweep_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "benchmark sweep",
        "Search settings of pretraining by the return of agents trained on the encoders, with Optuna; "
        "the same command goes on where it was stopped.",
        "benchmark sweep --env Nav2D-v0 --space objective_kwargs.c=0.5..0.99 --n-trials 10",
    )
    parser.add_argument("-o", "--output", default="sweep", metavar="DIR", help="folder; a benchmark's will do")
    parser.add_argument("--method", default="abisim", metavar="METHOD[,frozen]", help="to pretrain (default: abisim)")
    parser.add_argument("--env", required=True, metavar="ID", help="a registered id")
    parser.add_argument("--space", required=True, nargs="+", metavar="NAME=VALUES",
                        help="what to search: objective_kwargs.c=0.5..0.99 learning_rate=1e-4..1e-3:log "
                        "objective_kwargs.pairs=random|nearest; ssi.NAME=VALUES for the base's")  # fmt: skip
    parser.add_argument("--n-trials", type=int, default=20, help="settings to try (default: 20)")
    parser.add_argument("--batch", type=int, default=1, help="trials proposed at a time (default: 1)")
    parser.add_argument("--metric", choices=("final", "area"), default="final",
                        help="return of the last three evaluations, or of all of them (default: final)")  # fmt: skip
    parser.add_argument("--sampler-seed", type=int, default=0, help="of the settings that are proposed (default: 0)")
    _add_budget(parser)
    return parser


def _sweep(args: argparse.Namespace) -> None:
    from sb3_abisim.benchmark.sweep import TABLE_NAME, best_of, sweep

    root = Path(args.output)
    plan = _plan(args, [args.method], [args.env], final_episodes=0)
    trials = sweep(
        root, plan, args.space, args.n_trials, lambda: _engine(args), args.metric, args.batch, args.sampler_seed
    )
    print(f"trials: {root / TABLE_NAME}")
    best = best_of(trials)
    if best is not None:
        print(f"best is trial {best.number + 1}, {args.metric} {best.value:.2f}: {' '.join(best.encoders)}")
        print(_comparing_command(args, best.words))
    n_failed = sum(not trial.returns for trial in trials)
    if n_failed:
        print(f"{n_failed} trials failed; the logs are in {root / 'logs'}", file=sys.stderr)
        sys.exit(1)


def _comparing_command(args: argparse.Namespace, words: Sequence[str]) -> str:
    """A benchmark of the best trial and of learning from scratch, in the sweep's folder and with its budget."""
    command = [PROGRAM, "benchmark", "-o", args.output, "--env", args.env]
    command += ["--methods", args.method, "vanilla", "--seeds", *map(str, args.seeds)]
    names = "encoder_seeds algo n_transitions n_timesteps eval_freq eval_episodes n_eval_envs params packages image_key"
    for name in names.split():
        value = getattr(args, name)
        if value:
            command += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, list) else [value])]
    return shlex.join([*command, "--pretrain-params", *args.pretrain_params, *words])


COMMANDS = {
    "run": (_run_parser, _run),
    "report": (_report_parser, _report),
    "evaluate": (_evaluate_parser, _evaluate),
    "export": (_export_parser, _export),
    "hash": (_hash_parser, _hash),
    "sweep": (_sweep_parser, _sweep),
}
