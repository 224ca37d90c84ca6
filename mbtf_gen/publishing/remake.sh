#!/bin/sh
# Makes the data set again and compares every array with the published one.
# Usage: sh remake.sh [MATERIAL] [FOLDER]
# MATERIAL is the path of the material, unless its files are published beside this script.
# FOLDER is by default remade, beside the published folder.
set -eu
recipe=$(dirname "$0")
material="$recipe/material/material.yaml"
if [ ! -f "$material" ]; then
  if [ $# -lt 1 ]; then echo "error: name the material: sh $0 MATERIAL [FOLDER]" >&2; exit 2; fi
  material="$1"
  shift
fi
folder="${1:-$recipe/../../remade}"
mbtf-gen "$material" --config "$recipe/config.yaml" -o "$folder"
mbtf-gen verify "$folder" --digests "$recipe/digests.json"
