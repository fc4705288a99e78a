#!/usr/bin/env bash
# The program behind an emulator that runs beside it. statistics.jsonl has a line of statistics every second.
set -euo pipefail

python -m thermo.server 9001 &
server=$!
noack-netem --listen 127.0.0.1:9000 --to 127.0.0.1:9001 --both "loss 30% mansd 2" --stats-file statistics.jsonl >ready.txt &
emulator=$!
trap 'kill "$server" "$emulator" 2>/dev/null || true' EXIT

# The line `ready: listening on 127.0.0.1:9000` says that the emulator relays.
until grep -q ready ready.txt; do
    kill -0 "$emulator" || exit 1 # it has ended, and said why on standard error
    sleep 0.1
done

for place in boiler room outside; do
    python -m thermo.client 127.0.0.1 9000 "$place"
done

# Exit status 3: this machine has lost datagrams that the emulator did not; the run says nothing.
kill -INT "$emulator"
wait "$emulator"
