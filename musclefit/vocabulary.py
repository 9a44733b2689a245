"""The words that rigs, reports and proofs share: kinds of things by name, as rigs and reports write them."""

from __future__ import annotations

from enum import StrEnum


class Unit(StrEnum):
    """Length unit of files."""

    MILLIMETRE = "mm"
    CENTIMETRE = "cm"
    METRE = "m"

    @property
    def in_mm(self) -> float:
        """How many mm one of this unit is."""
        return {Unit.MILLIMETRE: 1.0, Unit.CENTIMETRE: 10.0, Unit.METRE: 1000.0}[self]


class Method(StrEnum):
    """A way to deform by its name, which stands for several settings; ``OWN`` is what the settings say one by one."""

    OWN = "own"
    YU2014 = "yu2014"
    RIGID_BONES = "rigid-bones"


class BackendKind(StrEnum):
    """What carries the displacement field between the handles."""

    RBF = "rbf"
    FFD = "ffd"
    LATTICE = "lattice"
    MULTILEVEL = "multilevel"


class StepKind(StrEnum):
    """How one step is made from a field."""

    EXPLICIT = "explicit"
    CAYLEY = "cayley"


class StepRule(StrEnum):
    """The sufficient condition for a step to be one-to-one."""

    ROW_NORM = "row-norm"
    GERSHGORIN = "gershgorin"
    MONOTONE = "monotone"


class TestedAt(StrEnum):
    """Where the step rule is tested."""

    __test__ = False  # pytest takes imported classes whose name begins with Test for test cases

    ALL_POINTS = "all-points"
    LANDMARKS = "landmarks"


class PathKind(StrEnum):
    """How handles travel from rest to their destinations."""

    STRAIGHT = "straight"
    JOINTS = "joints"
    SCREWS = "screws"
    CHAIN = "chain"


class BoneLimit(StrEnum):
    """How a bone may change where no joint moves it; bones that no limit names deform freely."""

    RIGID = "rigid"
    SIMILAR = "similar"


class Purpose(StrEnum):
    """What a deformation is for: another pose of the same body, or another body."""

    POSING = "posing"
    ANOTHER_BODY = "another-body"


class Compared(StrEnum):
    """What a result is shown beside, made of the same handles."""

    YU2014 = "yu2014"
    ONE_SHOT = "one-shot"


class CageCrossings(StrEnum):
    """What to do with a cage whose triangles cross each other."""

    REFUSE = "refuse"
    ACCEPT = "accept"


class Proof(StrEnum):
    """How a step was shown to be one-to-one."""

    MONOTONE = "strictly monotone"
    """The eigenvalues of the strain stay within the limits of the rule, on a convex domain."""
    PAIRS = "pair by pair"
    """No two places of a domain of any shape come together."""


class Claim(StrEnum):
    """What is known of a map, or of a deformed mesh, being one-to-one; different claims, never mixed."""

    CERTIFIED = "certified"
    """Proved, for all of a stated domain."""
    SAMPLED = "sampled"
    """Tested at stated points, and nowhere else."""
    UNDECIDED = "undecided"
    """A proof was tried and did not come to an end."""
    REFUTED = "refuted"
    """It folds: a place is proved."""
