#!/usr/bin/env bash
# The paper's comparison by GNU parallel, on this machine or on those of $HOSTS (as for parallel's --sshlogin; they must see the same folders):
#     host/cluster/parallel.sh 24 /scratch/paper target/release/snakectl
#     HOSTS=8/node1,8/node2 host/cluster/parallel.sh 24 /scratch/paper target/release/snakectl
# The same command goes on where it was stopped. What comes after goes to `snakectl report paper` as it is.
set -euo pipefail
shards=${1:?"how many shards?"}
out=$(realpath -m "${2:?"which folder?"}")
snakectl=$(realpath "${3:?"which program? target/release/snakectl, say"}")
shift 3
where=()
[ -z "${HOSTS:-}" ] || where=(--sshlogin "$HOSTS" --workdir .)
seq "$shards" | parallel --will-cite --halt soon,fail=1 "${where[@]}" \
    "$snakectl" report paper --shard "{}/$shards" --out "$out/{}" --jobs 1 "${*@Q}"
