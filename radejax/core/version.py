"""The version of radejax."""

__version__ = "0.2.0"
