#!/usr/bin/env bash
# Fetches the seven KITTI raw drives of the paper and their calibration, and verifies their counts.
#
#   data_scripts/download_kitti.sh [FOLDER]      default: data/kitti; tens of gigabytes, one drive at a time twice
#
# Resumable: a drive that is complete is left alone, a broken download continues. Any failure ends with
# a message and exit code 1. KITTI is CC BY-NC-SA 3.0; read http://www.cvlibs.net/datasets/kitti/ first.
set -euo pipefail

# KITTI_BASE_URL: a mirror with the same layout (a local one serves for trying this script out).
base="${KITTI_BASE_URL:-https://s3.eu-central-1.amazonaws.com/avg-kitti/raw_data}"
root="${1:-data/kitti}"
date=2011_09_30

# Drive and its OXTS packets (one a frame). Images are checked against them.
drives=(
    "0016 279"
    "0018 2762"
    "0020 1104"
    "0027 1106"
    "0028 5177"
    "0033 1594"
    "0034 1224"
)

fail() { printf 'error: %s\n' "$*" >&2; exit 1; }
count() { find "$1" -maxdepth 1 -type f -name "*.$2" 2>/dev/null | wc -l; }

for tool in curl unzip find; do
    command -v "$tool" >/dev/null || fail "\`$tool\` is not installed; install it and run this again"
done
mkdir -p "$root" || fail "cannot create $root"

# Downloads to a partial file, which a later run continues, and renames it when it is whole.
fetch() { # URL FILE
    [ -f "$2" ] && return
    # Cut off between the last byte and the renaming.
    if [ -f "$2.partial" ] && unzip -tqq "$2.partial" >/dev/null 2>&1; then
        mv "$2.partial" "$2"
        return
    fi
    curl --fail --location --retry 5 --retry-delay 5 --continue-at - --progress-bar --output "$2.partial" "$1" \
        || fail "could not download $1; run this again to continue (should it not, delete $2.partial first)"
    unzip -tqq "$2.partial" >/dev/null || { rm -f "$2.partial"; fail "$1 arrived damaged and was removed; run this again"; }
    mv "$2.partial" "$2"
}

complete() { # NUMBER FRAMES
    local drive="$root/$date/${date}_drive_$1_sync"
    # Some KITTI drives lack a few scans; depth from LiDAR leaves those pairs out.
    [ "$(count "$drive/velodyne_points/data" bin)" -gt $(($2 * 9 / 10)) ] || return
    [ "$(count "$drive/oxts/data" txt)" -eq "$2" ] && [ "$(count "$drive/image_02/data" png)" -eq "$2" ] && [ "$(count "$drive/image_03/data" png)" -eq "$2" ]
}

calibration=(calib_cam_to_cam.txt calib_velo_to_cam.txt calib_imu_to_velo.txt)
calibrated() { for file in "${calibration[@]}"; do [ -s "$root/$date/$file" ] || return 1; done; }

if ! calibrated; then
    echo "calibration of $date"
    fetch "$base/${date}_calib.zip" "$root/${date}_calib.zip"
    unzip -oq "$root/${date}_calib.zip" -d "$root" || fail "could not unpack the calibration"
    rm "$root/${date}_calib.zip"
fi
calibrated || fail "one of ${calibration[*]} is missing in $root/$date after unpacking the calibration"

for entry in "${drives[@]}"; do
    read -r number frames <<<"$entry"
    name="${date}_drive_${number}"
    if complete "$number" "$frames"; then
        echo "drive $number: complete, $frames frames"
        rm -f "$root/${name}_sync.zip"
        continue
    fi
    echo "drive $number: $frames frames"
    archive="$root/${name}_sync.zip"
    fetch "$base/$name/${name}_sync.zip" "$archive"
    # Unpacked aside and moved as a whole: a drive that has its name is complete, scans included.
    aside="$root/.unpacking-$number"
    drive="$root/$date/${name}_sync"
    rm -rf "$aside"
    unzip -oq "$archive" -d "$aside" || { rm -rf "$aside"; fail "could not unpack $archive (disk full?); run this again"; }
    rm -rf "$drive"
    mkdir -p "$root/$date"
    mv "$aside/$date/${name}_sync" "$drive" || fail "$archive does not hold $date/${name}_sync; delete it and run this again"
    rm -rf "$aside"
    complete "$number" "$frames" || fail "drive $number: expected $frames packets and images, found $(count "$drive/oxts/data" txt) packets, $(count "$drive/image_02/data" png) left and $(count "$drive/image_03/data" png) right images and $(count "$drive/velodyne_points/data" bin) scans in $drive; delete $archive and run this again"
    rm "$archive"
done
echo "all drives complete in $root; next: relcov inspect --config configs/kitti.toml --set data.root=$root"
