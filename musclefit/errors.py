"""The errors a user can meet: each names the thing, the value found and the way out."""

from __future__ import annotations


class MusclefitError(Exception):
    """Base of every error that musclefit raises on purpose."""


class InputError(MusclefitError):
    """Something the user gave cannot be used; the message names it, the value found and the way out."""


class MeshError(InputError):
    """A surface or tet mesh cannot be used as it is."""


class RigError(InputError):
    """A rig table or a file it names is wrong; the message starts with the file and the key."""


class LandmarkError(InputError):
    """Landmarks, handles or a cage cannot drive a deformation."""


class FieldError(MusclefitError):
    """A displacement field could not be fitted."""


class NotConvergedError(MusclefitError):
    """A deformation ended early and the caller required it whole; carries the deformation as ``result``."""

    def __init__(self, message: str, result: object) -> None:
        self.result = result
        super().__init__(message)

    def __reduce__(self) -> tuple[type[NotConvergedError], tuple[str, object]]:
        """So that it reaches the caller from a worker process as it is."""
        return type(self), (str(self), self.result)
