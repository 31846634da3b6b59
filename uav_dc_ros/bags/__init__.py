"""MCAP bags without a ROS installation."""

COMPRESSIONS = ("zstd", "lz4", "none")  # of chunks; here, since the writer is slow to import
