#!/usr/bin/env python3
"""The paper's comparison in shards on a HyperQueue cluster.

    python3 host/cluster/on_hyperqueue.py --shards 24 --out /scratch/paper target/release/snakectl
    python3 host/cluster/on_hyperqueue.py --server ~/.hq-server/hq-current --shards 24 --out /scratch/paper target/release/snakectl

Without --server it starts a cluster of its own with --workers workers in this process. Every shard has a folder of its own in --out, and a task that
goes on where it was: after whatever happened, the same command again. What stands after -- goes to `snakectl report paper` as it is.
"""

import argparse
import os
import sys
from pathlib import Path

from hyperqueue import Client, Job, LocalCluster
from hyperqueue.client import FailedJobsException
from hyperqueue.cluster import WorkerConfig
from hyperqueue.ffi.protocol import ResourceRequest


def main():
    mine, more = sys.argv[1:], []
    if "--" in mine:
        more = mine[mine.index("--") + 1 :]
        mine = mine[: mine.index("--")]
    parser = argparse.ArgumentParser(description="Works on the paper's comparison in shards on a HyperQueue cluster.")
    parser.add_argument("snakectl", type=Path, help="the program")
    parser.add_argument("--shards", type=int, required=True, help="shards to make of the comparison")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards' folders; all workers must see it")
    parser.add_argument("--server", type=Path, help="server directory of a cluster that runs already")
    parser.add_argument("--workers", type=int, default=1, help="without one: workers to start")
    parser.add_argument("--cores", type=int, default=1, help="cores of a shard")
    arguments = parser.parse_args(mine)
    if arguments.shards < 1:
        sys.exit(f"--shards is {arguments.shards}; it must be at least 1")
    program = arguments.snakectl.resolve()
    if not os.access(program, os.X_OK):
        sys.exit(f"{program} is no program: build it with `cargo build --release`")

    cluster = None if arguments.server else LocalCluster()
    try:
        if cluster:
            for _ in range(arguments.workers):
                cluster.start_worker(WorkerConfig(cores=arguments.cores))
        client = Client(arguments.server) if arguments.server else cluster.client()
        job = Job()
        for shard in range(1, arguments.shards + 1):
            folder = arguments.out.resolve() / str(shard)
            folder.mkdir(parents=True, exist_ok=True)
            command = ["report", "paper", "--shard", f"{shard}/{arguments.shards}", "--out", str(folder)]
            job.program(
                [str(program), *command, "--jobs", str(arguments.cores), *more],
                name=f"shard {shard}",
                stdout=str(folder / "stdout.txt"),
                stderr=str(folder / "stderr.txt"),
                resources=ResourceRequest(cpus=arguments.cores),
            )
        submitted = client.submit(job)
        try:
            client.wait_for_jobs([submitted])
        except FailedJobsException as failed:
            sys.exit(f"not all shards are done; the same command goes on where they were. {failed}")
    finally:
        if cluster:
            cluster.stop()
    print(f"all {arguments.shards} shards are done: snakectl report paper --merge {arguments.out}/*")


main()
