# check.sh FOLDER [OPTIONS of relight]: exit 0 when the picture is the kept one, 1 when it differs, more for an error.
# The kept picture has 1 % of noise, and the light's texels soften shadows a little: 1.5 %. FLIP sees what an eye would.
set -eu
folder=$1
shift
"${RELIGHTCLI:-relightcli}" relight "$folder/transfer.zarr" "$@" -o "$folder/now.exr"
"${RELIGHTCLI:-relightcli}" diff "$folder/now.exr" "$folder/kept.exr" \
  --metric relrmse --metric flip --fail relrmse=0.015 --fail flip=0.03 --report "$folder/report.html"
