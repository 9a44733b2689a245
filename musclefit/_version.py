"""The version of musclefit, from the installed package."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("musclefit")
except PackageNotFoundError:  # a checkout that is on the path but not installed
    __version__ = "0+not-installed"
