"""Speed of pretraining beside a straightforward PyTorch loop on the same network, loss, batch size and data.

The straightforward loop is a ``torch.utils.data.Dataset`` that indexes one transition after the other and makes it
float32, a ``DataLoader`` that shuffles and stacks them, channels first, and Adam. Ours is measured with single
transitions and, where the trained encoder embeds both observations, with ``chunk_length: 8``. The loops run in turns on
one core, each in its process, because ours sets the allocator (``sb3_abisim.common.malloc``). The speed of each is that
of its fastest turn, by processor time, which load on the machine disturbs less than the clock. ``make bench``.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "pretraining.md"
AIM = 3.0
BATCH_SIZE = 256
# (objective, lengths of chunks)
OBJECTIVES = (("ssi", (1, 8)), ("abisim", (1,)))
ENV_IDS = ("Nav2D-v0", "PointMaze-v0")
N_TRANSITIONS = 20_000


def straightforward(run: Any) -> Iterator[float]:
    """One update after another of a plain loop over the run's data; yields the loss."""
    import numpy as np
    import torch as th

    from sb3_abisim.objectives.base import TensorBatch

    dataset = run.dataset
    shards = [np.load(path, mmap_mode="r") for path in sorted(dataset.path.glob("frames-*.npy"))]
    offsets = np.cumsum([0] + [len(shard) for shard in shards])
    starts, steps = dataset.pairs(run.config.k, "train")
    actions = dataset.actions(np.arange(dataset.n_frames))

    class Transitions(th.utils.data.Dataset[Any]):
        def __len__(self) -> int:
            return len(starts)

        def __getitem__(self, i: int) -> Any:
            t, k = starts[i], steps[i]
            shard = int(np.searchsorted(offsets, t, side="right")) - 1
            pair = (shards[shard][t - offsets[shard] + step] for step in (0, k))
            frames = (th.from_numpy(frame.astype(np.float32)) / 255.0 for frame in pair)
            return *frames, th.as_tensor(actions[t : t + k] if module.reads_action_sequences else actions[t])

    module = run.module.to(memory_format=th.contiguous_format)
    module.train()
    optimizer = th.optim.Adam([p for p in module.parameters() if p.requires_grad], lr=1e-3)
    while True:
        for obs, next_obs, taken in th.utils.data.DataLoader(Transitions(), BATCH_SIZE, shuffle=True, drop_last=True):
            obs, taken, next_obs = (tensor.to(run.device) for tensor in (obs, taken, next_obs))
            loss, _ = module.loss(TensorBatch.of(obs, taken, next_obs))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            module.after_step()
            yield float(loss.detach())


def ours(run: Any) -> Iterator[float]:
    """The same by :mod:`sb3_abisim.pretraining.trainer`."""
    for batch in run._batches():
        yield float(run._update(batch)["loss"])


def make_run(
    objective: str,
    data: Path,
    base: str | None,
    folder: Path,
    chunk_length: int = 1,
    device: str = "cpu",
    settings: dict[str, Any] | None = None,
) -> Any:
    """A pretraining run that has not begun."""
    from sb3_abisim.data.dataset import TransitionDataset
    from sb3_abisim.pretraining.config import load_config
    from sb3_abisim.pretraining.trainer import PretrainRun

    dataset = TransitionDataset(data, verify=False)
    config = load_config(
        objective,
        dataset.env_id,
        {"batch_size": BATCH_SIZE, "n_updates": 10**6, "chunk_length": chunk_length, **(settings or {})},
    )
    return PretrainRun(objective, dataset, folder / "x.safetensors", config, base, seed=0, device=device)


def serve_turns(pipe: Any, objective: str, data: Path, base: str | None, chunk_length: int) -> None:
    """In a child process: for every number of updates received, send the transitions per second; stop at 0.

    :param pipe: the process's end of a pipe
    :param chunk_length: of our loop; 0 for the straightforward one
    """
    use_one_core()
    if chunk_length:
        from sb3_abisim.common.malloc import keep_freed_memory

        # As sb3_abisim.pretraining.pretrain does.
        keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        run = make_run(objective, data, base, Path(folder), max(chunk_length, 1))
        loop = ours(run) if chunk_length else straightforward(run)
        next(loop)
        while n_updates := pipe.recv():
            start = time.process_time()
            for _ in range(n_updates):
                next(loop)
            pipe.send(n_updates * BATCH_SIZE / (time.process_time() - start))


def fastest_turns(
    objective: str, data: Path, base: str | None, chunk_lengths: list[int], rounds: int, n_updates: int
) -> dict[int, float]:
    """Transitions per second of the fastest turn of each loop, by its ``chunk_length`` (:func:`serve_turns`)."""
    context = multiprocessing.get_context("spawn")
    pipes = {}
    for length in chunk_lengths:
        pipes[length], theirs = context.Pipe()
        context.Process(target=serve_turns, args=(theirs, objective, data, base, length), daemon=True).start()
        theirs.close()
    best = dict.fromkeys(chunk_lengths, 0.0)
    for _ in range(rounds):
        for length, pipe in pipes.items():
            pipe.send(n_updates)
            best[length] = max(best[length], pipe.recv())
    for pipe in pipes.values():
        pipe.send(0)
    return best


def matmul_rate() -> float:
    """GFLOP/s of a float32 product of two 1024 x 1024 matrices, fastest of ten."""
    import torch as th

    a = th.rand(1024, 1024)
    times = []
    for _ in range(10):
        start = time.process_time()
        a @ a
        times.append(time.process_time() - start)
    return 2 * 1024**3 / min(times) / 1e9


def flops_per_update(run: Any) -> int:
    """Floating-point operations of one update, as torch counts them (convolutions and products)."""
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        next(ours(run))
    return int(counter.get_total_flops())


def shares(run: Any, n_updates: int) -> dict[str, float]:
    """Share of the time of our loop by phase."""
    import torch as th

    seconds = {"data": 0.0, "loss": 0.0, "gradients": 0.0, "optimizer and checks": 0.0}
    plain_loss, plain_backward = run.module.loss, th.Tensor.backward

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            result = function(*args, **kwargs)
            seconds[name] += time.process_time() - start
            return result

        return call

    run.module.loss, th.Tensor.backward = timed("loss", plain_loss), timed("gradients", plain_backward)  # type: ignore[method-assign]
    try:
        batches, begin = run._batches(), time.process_time()
        for _ in range(n_updates):
            start = time.process_time()
            batch = next(batches)
            seconds["data"] += time.process_time() - start
            run._update(batch)
        total = time.process_time() - begin
    finally:
        run.module.loss, th.Tensor.backward = plain_loss, plain_backward  # type: ignore[method-assign]
    seconds["optimizer and checks"] = total - sum(seconds.values())
    return {name: value / total for name, value in seconds.items()}


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_pretraining", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=8, help="turns of each loop (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=6, help="updates per turn (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    from sb3_abisim.common.malloc import keep_freed_memory
    from sb3_abisim.data.collect import collect

    keep_freed_memory()  # for the shares of our time
    peak = matmul_rate()
    rows, notes = [], []
    for env_id in ENV_IDS:
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data"
            collect(env_id, N_TRANSITIONS, data)
            for objective, chunk_lengths in OBJECTIVES:
                base = f"{env_id}/ssi" if objective == "abisim" else None
                speed = fastest_turns(objective, data, base, [0, *chunk_lengths], args.rounds, args.updates)
                plain = speed.pop(0)
                for length, fast in speed.items():
                    run = make_run(objective, data, base, Path(folder), length)
                    flops = flops_per_update(run) * fast / BATCH_SIZE / 1e9
                    parts = ", ".join(f"{name} {share:.0%}" for name, share in shares(run, 2 * args.updates).items())
                    label = f"`{objective}`, {env_id}" + (f", `chunk_length: {length}`" if length > 1 else "")
                    ratio = fast / plain
                    numbers = f"{plain:,.0f} | {fast:,.0f} | {ratio:.1f} | {AIM:.0f} | {flops:.0f}"
                    rows.append(f"| {label} | {numbers} | {ratio * peak / flops:.1f} |")
                    notes.append(f"* {label}: {parts}")
                    print(rows[-1], notes[-1], flush=True)
    text = (
        f"`python -m benchmarks.bench_pretraining` on {machine()}, batches of {BATCH_SIZE}: transitions per second of "
        f"processor time in the fastest of {args.rounds} turns of {args.updates} updates. A product of two 1024 x 1024 "
        f"matrices reaches {peak:.0f} GFLOP/s on this core; the bound is the ratio that ours would have at that "
        "rate, with no time for anything but convolutions and products."
    )
    header = [
        "| objective, environment | straightforward | ours | ratio | aim | ours, GFLOP/s | bound |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    write_page(args.output, "Speed of pretraining", text, header, rows, ("Where our time goes:", "", *notes, ""))


if __name__ == "__main__":
    main()
