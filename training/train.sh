#!/usr/bin/env bash
# Trains, exports and draws every network: ./training/train.sh [SAMPLES]. Can be stopped and started again.
set -euo pipefail
cd "$(dirname "$0")/.."
samples=${1:-500000}
if [ ! -x training/.venv/bin/python ]; then
  python3 -m venv training/.venv
  training/.venv/bin/pip install -r training/requirements.txt
fi
python=training/.venv/bin/python
cargo build --release --locked
for scene in energy-1mm-64 paper-8mm-64; do
  for network in cnn16 cnn16-separable unet; do
    run=training/runs/$network-$scene
    $python training/train.py --network $network --scene training/scenes/$scene.toml --out "$run" --samples "$samples"
    $python training/export.py --run "$run" --scene training/scenes/$scene.toml --out config/models/$network-$scene.onnx || true
  done
done
$python training/curve.py training/runs/* --out training/validation.svg
