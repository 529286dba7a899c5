"""Error metrics."""

from relightcli.core.measure.errors import psnr, relative_rmse, rmse

__all__ = ["psnr", "relative_rmse", "rmse"]
