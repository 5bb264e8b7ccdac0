#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The distribution as a user gets it: built, checked, installed in a clean environment away from the checkout, its demo mapped.
#
#   benchmarks/house/wheel.sh [FOLDER [EXTRA]]     FOLDER: new, by default a temporary one; EXTRA: ros (the demo through the nodes)
#
# Prints the size of the wheel and the seconds of every step. Needs `build` and `twine` (requirements-dev.txt).
set -euo pipefail
root=$(cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../.." && pwd)
folder=${1:-$(mktemp -d)} extra=${2:-}
python=${PYTHON:-python3}
mkdir -p "$folder"

timed() {
  local name=$1 start=$SECONDS
  shift
  "$@" >"$folder/$name.log" 2>&1 || { tail -n 30 "$folder/$name.log" >&2; echo "$name failed: $folder/$name.log" >&2; exit 1; }
  printf '%-10s %4d s\n' "$name" $((SECONDS - start))
}

timed build "$python" -m build --no-isolation --outdir "$folder/dist" "$root"
timed check "$python" -m twine check --strict "$folder"/dist/*
wheel=$(echo "$folder"/dist/*.whl)
echo "wheel      $(($(stat -c %s "$wheel") / 1000000)) MB, $(basename "$wheel")"

"$python" -m venv "$folder/venv"
# Nothing of the checkout, of another environment or of a sourced ROS installation may help.
unset PYTHONPATH AMENT_PREFIX_PATH VIRTUAL_ENV
PATH=$folder/venv/bin:$PATH
cd "$folder"
timed install pip install "$wheel${extra:+[$extra]}"
timed help slam --help
timed library python -c 'from indoor_slam import StereoSlam; import sys; assert "rclpy" not in sys.modules; print(StereoSlam)'
demo=$(python -c 'from slam_bringup.processes.kernels import DEMO; print(DEMO)')
timed warmup slam warmup "$demo"
timed demo slam demo -o out/demo
timed run slam run "$demo" -o out/run
timed simulate slam simulate demo -o bag --frames 2
if [ -z "$extra" ]; then
  if slam play "$demo" 2>play.log; then echo "slam play ran without ROS" >&2; exit 1; fi
  cat play.log
  if slam experiment planar --quick --workers 2 -o out/page >experiment.log 2>&1; then echo "slam experiment ran without distributed" >&2; exit 1; fi
  tail -n 1 experiment.log
fi
