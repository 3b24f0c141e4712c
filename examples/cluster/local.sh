#!/bin/sh
# A cluster on this machine, for as long as a command runs:
#
#     examples/cluster/local.sh autoalign batch pictures --reference reference.png --out-dir out
#
# The command finds the scheduler's address in AUTOALIGN_SCHEDULER, and so needs no --scheduler.
set -eu

folder=$(mktemp -d)
export DASK_TEMPORARY_DIRECTORY="$folder"
scheduler_file=$folder/scheduler.json
# The worker first: one that loses its scheduler while it is being ended may wait for ever.
trap 'kill $worker 2>/dev/null; wait $worker; kill $scheduler 2>/dev/null; wait; rm -rf "$folder"' EXIT
trap 'exit 130' INT TERM

dask scheduler --host 127.0.0.1 --port 0 --no-dashboard --scheduler-file "$scheduler_file" &
scheduler=$!
# Two threads: two jobs at a time. No nanny, because a worker under one may have no processes of its own.
dask worker --scheduler-file "$scheduler_file" --nthreads 2 --no-nanny --no-dashboard &
worker=$!
until [ -s "$scheduler_file" ]; do
    kill -0 "$scheduler" "$worker"  # or there is nothing to wait for
    sleep 0.1
done

AUTOALIGN_SCHEDULER=$(sed -n 's/.*"address": "\([^"]*\)".*/\1/p' "$scheduler_file")
export AUTOALIGN_SCHEDULER
"$@"
