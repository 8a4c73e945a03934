#!/bin/sh
# Real frames, the whole path: KITTI tracking frames in, a category model of their cars and its novel views out.
#
#   examples/02_real_frames.sh KITTI/training out/real [SEQUENCE] [FRAMES] [SEGMENTER] [MODEL]
#
# KITTI/training has KITTI tracking's own layout (image_02, label_02, calib). SEGMENTER is `grabcut` (needs nothing) or
# `onnx:FILE`, a semantic-segmentation network, which is better on real frames. MODEL is a bundled one: car-gaussians or
# car-nerf-small. Takes five minutes on three cores; what an earlier call finished is not done again. Two dozen
# frames hold too few views to learn a car's unseen sides from: the fine-tuned run starts from the bundled weights, which
# have seen synthetic cars only.
set -eu
[ $# -ge 2 ] || { echo "usage: $0 KITTI/training OUT [SEQUENCE] [FRAMES] [SEGMENTER] [MODEL]" >&2; exit 2; }
run=$(dirname -- "$0")/../run
root=$1 out=$2 sequence=${3:-0001} frames=${4:-0-24} segmenter=${5:-grabcut} model=${6:-car-gaussians}

case $segmenter in onnx:*) "$run" setup onnx ;; esac
"$run" carstudio build kitti-mot --root "$root" --sequence "$sequence" --frames "$frames" --segmenter "$segmenter" \
    --out "$out/cars"
"$run" carstudio report "$model" --data "$out/cars" --split view --out "$out/zero-shot-report"
case $model in car-gaussians*) gentle=2e-4 ;; *) gentle=5e-4 ;; esac
for start in scratch pretrained; do
    options="--minutes 3"
    # Gently: at the recipe's own learning rate a few views make the model forget what cars look like.
    [ "$start" = scratch ] || options="--steps 500 --learning-rate $gentle --init $model"
    [ ! -f "$out/$start/training.safetensors" ] || options="$options --resume"
    # shellcheck disable=SC2086  # several options
    "$run" carstudio train "$model" --data "$out/cars" --split view --out "$out/$start" $options
    "$run" carstudio report "$out/$start" --data "$out/cars" --split view --out "$out/$start-report"
done
