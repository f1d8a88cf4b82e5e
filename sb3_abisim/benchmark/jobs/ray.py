"""Run the jobs of a benchmark on a Ray cluster: the same jobs, in separate programs on its nodes.

The benchmark's folder must be a shared one, at the same path on every node, and the nodes must have this version of the
package. Ray starts a job again, on another node, when it has lost the worker that ran it.
"""

import logging
import os
import socket
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.jobs.job import Job
from sb3_abisim.benchmark.jobs.launch import JobError, launch
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import write_atomic


class RayEngine:
    """Jobs as Ray tasks.

    :param n_jobs: jobs at a time; None for as many as the cluster has processors for
    :param threads: of each job, which asks for as many processors
    :param address: of the cluster, ``host:port`` or "auto" for the one of this machine
    :param gpus: per job; a part of one is shared
    :param retries: how often a job is started again after a lost worker
    :raises ValueError: if Ray is not installed, there is no cluster, or it has too little for one job
    """

    def __init__(
        self, n_jobs: int | None = None, threads: int = 1, address: str = "auto", gpus: float = 0.0, retries: int = 3
    ) -> None:
        with needs_extra("distributed", "--engine ray"):
            import ray
        if n_jobs is not None and n_jobs < 1:
            raise ValueError(f"n_jobs must be at least 1, got {n_jobs}")
        self._ray = ray
        try:
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        except ConnectionError as error:
            raise ValueError(f"no Ray cluster at {address!r} ({error}); start one with: ray start --head") from error
        nodes: list[dict[str, float]] = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        room = 0
        for node in nodes:  # a job does not lie on two
            fitting = int(node.get("CPU", 0) // threads)
            room += min(fitting, int(node.get("GPU", 0) / gpus)) if gpus else fitting
        if room < 1:
            ray.shutdown()
            raise ValueError(f"no node has room for a job of {threads} processors and {gpus} GPUs: {nodes}")
        self.n_slots, self.threads = room if n_jobs is None else n_jobs, threads
        self._options = {"num_cpus": threads, "num_gpus": gpus, "max_retries": retries}

    def submit(self, root: Path, job: Job) -> "Future[None]":
        """Hand a job to the cluster."""
        root = root.resolve()
        token = root / "shared_folder"
        if not token.is_file():
            text = f"{socket.gethostname()} {os.getpid()} {time.time()}"
            write_atomic(token, lambda file: file.write(text.encode()))
        task = self._ray.remote(_execute).options(name=job.title, **self._options)
        reference = task.remote(str(root), token.read_text(), __version__, job.to_json(), self.threads)
        future: Future[None] = reference.future()
        return future

    def close(self) -> None:
        """Leave the cluster, which ends what still runs for this program."""
        self._ray.shutdown()


def _execute(root: str, token: str, version: str, job: dict[str, Any], threads: int) -> None:
    """On a node: refuse what would go wrong later, then do as everywhere else."""
    host = socket.gethostname()
    if version != __version__:
        raise JobError(f"{host} has sb3_abisim {__version__}, this benchmark runs with {version}; install that one")
    path = Path(root) / "shared_folder"
    if not path.is_file() or path.read_text() != token:
        raise JobError(f"{root} is not the benchmark's folder on {host}; give a folder that all nodes share")
    launch(Path(root), job, threads)
