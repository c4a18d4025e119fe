#!/usr/bin/env bash
# What the container does, tried without Docker: another user, a read-only installation, no home, one folder
# to write to. As root:  deploy/try.sh INSTALLATION MAPS [PORT]
# INSTALLATION: a virtual environment as deploy/Dockerfile makes it, warmed into its folder `compiled`:
#   python3 -m venv X && X/bin/pip install . ./packages/placegraph-io ./packages/placegraph-serve
#   NUMBA_CPU_NAME=generic X/bin/placegraph --compiled X/compiled warm
set -eu
made=$(realpath "$1") maps=$(realpath "$2") port=${3:-8933}
if [ -z "${INSIDE:-}" ]; then
  INSIDE=1 exec unshare --mount --propagation private "$0" "$made" "$maps" "$port"
fi
for folder in "$made" "$maps"; do
  mount --bind "$folder" "$folder"
  mount -o remount,ro,bind "$folder"
done
room=$(mktemp -d)
mount -t tmpfs -o mode=1777 tmpfs "$room"
cd "$room"
setpriv --reuid 61234 --regid 61234 --clear-groups --no-new-privs --inh-caps=-all --bounding-set=-all \
  env -i PATH="$made/bin:/usr/bin:/bin" TMPDIR="$room" NUMBA_CPU_NAME=generic \
  placegraph --compiled "$made/compiled" serve "$maps" --host 127.0.0.1 --port "$port" &
server=$!
trap 'kill $server; wait $server || true' EXIT
url=http://127.0.0.1:$port
start=$(date +%s.%N)
until [ "$(curl -s -o answer -w '%{http_code}' "$url/healthz")" = 200 ]; do
  kill -0 $server
  sleep 0.2
done
echo "ready after $(echo "$(date +%s.%N) - $start" | bc) s"
curl -s --fail-with-body -o answer -w 'a sentence: %{http_code}, %{time_total} s\n' "$url/v1/locate" \
  --json '{"text": "A bakery is north of me. I am in the kitchen."}'
echo "written beside answers: $(find "$room" -type f ! -name answer | wc -l) files"
