"""HDR-NSFF: alternating-exposure video in, dynamic HDR radiance field out."""

__version__ = "0.2.0.dev0"
