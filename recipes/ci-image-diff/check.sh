# check.sh FOLDER [OPTIONS of relight]: exit 0 when the picture is the kept one, 1 when it differs, more for an error.
# 2.5 % is for the kept picture's noise (1 %) and for shadows that the light's texels soften; FLIP sees what an eye would.
set -eu
folder=$1
shift
"${RELIGHTCLI:-relightcli}" relight "$folder/transfer.zarr" "$@" -o "$folder/now.exr"
"${RELIGHTCLI:-relightcli}" diff "$folder/now.exr" "$folder/kept.exr" \
  --metric relrmse --metric flip --fail relrmse=0.025 --fail flip=0.03 --report "$folder/report.html"
