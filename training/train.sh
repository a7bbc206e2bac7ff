#!/usr/bin/env bash
# Trains, exports and draws every network of the paper's table: ./training/train.sh [MINUTES] [SAMPLES]
# or one for the lens of a config, by its calibration: ./training/train.sh --config oapwatch.toml [MINUTES] [SAMPLES]
# MINUTES is the CPU time for each 64 × 64 network; others get their share by the number of pixels (between 1/4 and 2 times).
# On a GPU where PyTorch finds one (DEVICE=cpu prevents it); MINUTES are then the clock's.
# Can be stopped at any time and started again. Then: oapwatch tradeoff --networks training/models
set -euo pipefail
config=
if [ "${1:-}" = --config ]; then
  config=$(realpath "${2:?--config: expected a config file}")
  shift 2
fi
cd "$(dirname "$0")/.."
minutes=${1:-60}
samples=${2:-500000}
sizes=${SIZES:-10 20 40 60 64 80 100}
readings=${READINGS:-energy-1mm paper-8mm}
networks=${NETWORKS:-cnn16 cnn16-separable unet}
python=${PYTHON:-training/.venv/bin/python}
program=${PROGRAM:-target/release/oapwatch}
device=${DEVICE:-auto}
target_m=${TARGET_M:-0}
if [ ! -x "$python" ]; then
  python3 -m venv training/.venv
  training/.venv/bin/pip install -r training/requirements.txt
fi
if [ ! -x "$program" ]; then cargo build --release --locked; fi
mkdir -p training/runs training/models
if [ -n "$config" ]; then
  scene=training/runs/own-lens.toml
  read -r width_std sigma_px lens < <("$python" training/device.py --config "$config" --light training/scenes/energy-1mm.toml --out "$scene")
  # Where a spot is wider than four convolutions see, frames are whitened.
  network=${NETWORKS:-cnn16}$(awk "BEGIN { if ($sigma_px > 4) print \"-white\" }")
  run=training/runs/own-lens-$network-$lens
  "$python" training/train.py --program "$program" --network "$network" --scene "$scene" --out "$run" --samples "$samples" --minutes "$minutes" \
    --device "$device" --target-sigma-m "$target_m" --devices 16 --width-std "$width_std"
  "$python" training/export.py --program "$program" --run "$run" --scene "$scene" --out training/models/own-lens.onnx
  exit
fi
# A U-Net is given fewer samples than it could use: each begins with what the next smaller array's has learned.
declare -A smaller
for pixels in $sizes; do
  for reading in $readings; do
    scene=training/runs/$reading-$pixels.toml
    sed "s/^pixels = .*/pixels = [$pixels, $pixels]/" "training/scenes/$reading.toml" > "$scene"
    # Where spots melt into each other, a network learns from whitened frames what it does not from plain ones.
    front=""
    if [ "$reading" = paper-8mm ]; then front=-white; fi
    for network in $networks; do
      name=$network$front
      run=training/runs/$name-$reading-$pixels
      share=$(awk "BEGIN { s = $pixels^2 / 64^2; print $minutes * (s < 0.25 ? 0.25 : s > 2 ? 2 : s) }")
      from=()
      if [ "$network" = unet ] && [ -n "${smaller[$name-$reading]:-}" ]; then from=(--from-run "${smaller[$name-$reading]}"); fi
      smaller[$name-$reading]=$run
      "$python" training/train.py --program "$program" --network "$name" --scene "$scene" --out "$run" --samples "$samples" --minutes "$share" --device "$device" --target-sigma-m "$target_m" "${from[@]}"
      "$python" training/export.py --program "$program" --run "$run" --scene "$scene" --out "training/models/$name-$reading-$pixels.onnx"
    done
  done
done
"$python" training/curve.py training/runs/*/ --out training/models/validation.svg
