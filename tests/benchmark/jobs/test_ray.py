"""The same jobs on a cluster of two nodes, one of which dies."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.graph import build
from sb3_abisim.benchmark.jobs.job import Job
from sb3_abisim.benchmark.jobs.launch import JobError
from sb3_abisim.benchmark.jobs.local import run_jobs
from sb3_abisim.benchmark.jobs.ray import RayEngine, _execute
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.benchmark.sweep import sweep

# Ray's own programs leave sockets and files open.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
PLAN = Plan(
    methods=("vanilla",), env_ids=("Nav2D-v0",), seeds=(0, 1), n_timesteps=2000, eval_freq=500, eval_episodes=4,
    final_episodes=0, params=("dqn.learning_starts:100",), device="cpu",
)  # fmt: skip


def test_a_node_of_another_version_or_without_the_folder_is_refused(tmp_path: Path) -> None:
    job = build(PLAN)[0].to_json()
    with pytest.raises(JobError, match=r"has sb3_abisim .* runs with 0\.0\.1"):
        _execute(str(tmp_path), "token", "0.0.1", job, 1)
    with pytest.raises(JobError, match="a folder that all nodes share"):
        _execute(str(tmp_path), "token", __version__, job, 1)
    assert not list(tmp_path.iterdir())


def test_no_jobs_at_a_time_are_refused() -> None:
    pytest.importorskip("ray")
    with pytest.raises(ValueError, match="n_jobs must be at least 1, got 0"):
        RayEngine(n_jobs=0)


@pytest.mark.slow
def test_a_killed_node_costs_its_job_another_start_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    # Ray's workers are nice to others, which makes them crawl on a busy machine.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node = cluster.add_node(num_cpus=1)
    killed: list[float] = []

    class KillingEngine(RayEngine):
        """Kills the second node once both jobs train."""

        def submit(self, root: Path, job: Job) -> Any:
            future = super().submit(root, job)
            list_running.append(job)
            if len(list_running) == 2:
                deadline = time.monotonic() + 300
                while len(list(root.glob("work/*/dqn/*/evaluations.npz"))) < 2 and time.monotonic() < deadline:
                    time.sleep(0.1)
                cluster.remove_node(node, allow_graceful=False)
                killed.append(time.monotonic())
            return future

    list_running: list[Job] = []
    try:
        jobs = build(PLAN)
        with pytest.raises(ValueError, match=r"no node has room for a job of 2 processors and 0\.0 GPUs"):
            RayEngine(threads=2, address=cluster.address)
        engine = KillingEngine(address=cluster.address)
        assert engine.n_slots == 2
        assert run_jobs(tmp_path, jobs, engine, progress=False) == {}
        assert killed and len(list_running) == 2
        starts = [(tmp_path / "logs" / f"{job.name}.log").read_text().count("$ sb3-abisim train") for job in jobs]
        assert sorted(starts) == [1, 2], "the job on the dead node starts again, the other does not"
        for job in jobs:
            evaluations = np.load(tmp_path / job.output / "evaluations.npz")
            assert evaluations["timesteps"].tolist() == [500, 1000, 1500, 2000]
        assert not list(tmp_path.glob("work/*")), "nothing half done is left"
    finally:
        cluster.shutdown()


@pytest.mark.slow
def test_a_sweep_takes_a_fresh_engine_for_each_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_worker_niceness", "0")
    from ray.cluster_utils import Cluster

    plan = Plan(
        methods=("ssi",), env_ids=("Nav2D-v0",), seeds=(0,), encoder_seeds=(0,), n_transitions=1000, n_timesteps=400,
        eval_freq=200, eval_episodes=2, final_episodes=0, params=("dqn.learning_starts:100",), device="cpu",
        pretrain_params=("n_updates:4", "log_interval:2", "checkpoint_interval:2"),
    )  # fmt: skip
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    engines: list[RayEngine] = []

    def make_engine() -> RayEngine:
        engines.append(RayEngine(address=cluster.address))
        return engines[-1]

    try:
        trials = sweep(tmp_path, plan, ["batch_size=16..64"], n_trials=2, make_engine=make_engine)
    finally:
        cluster.shutdown()
    assert len(engines) == 2 and all(len(trial.returns) == 1 for trial in trials)
    assert trials[0].params != trials[1].params
