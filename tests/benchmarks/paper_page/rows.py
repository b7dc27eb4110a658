"""What the page is made of: lines in blocks in sections, and who is better in each."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

BETTER, LEVEL, WORSE, APART = "better", "level", "worse", "not comparable"
VERDICTS = (BETTER, LEVEL, WORSE, APART)

LEVEL_RATIO = 0.02
"""Times, errors and sizes that differ by less count as level."""

LEVEL_DB = 0.5
"""The same of PSNRs."""


@dataclass(frozen=True)
class Measure:
    """What a block counts: its name, its unit, and which way is better."""

    name: str
    unit: str
    higher_is_better: bool = False

    def compare(self, ours: float | None, theirs: float | None) -> str:
        """Say how ours stands to theirs."""
        if ours is None or theirs is None:
            return APART
        if self.higher_is_better:
            margin = ours - theirs
            if abs(margin) < LEVEL_DB:
                return LEVEL
            return BETTER if margin > 0.0 else WORSE
        if abs(ours - theirs) <= LEVEL_RATIO * abs(theirs):
            return LEVEL
        return BETTER if ours < theirs else WORSE


@dataclass(frozen=True)
class Line:
    """One figure of the paper, and ours.

    Attributes
    ----------
    case : str
        The eye, or the row of the paper's table.
    published : float or str or None
        As printed, in the block's unit; words stand for what is no single number.
    ours : float or str or None
        Ours beside the published one.
    rebuilt : float or None
        The same system built anew by this project, measured on our machine.
    ours_there : float or None
        Ours on that machine, in the conditions of ``rebuilt``.
    """

    case: str
    published: float | str | None
    ours: float | str | None = None
    rebuilt: float | str | None = None
    ours_there: float | None = None


@dataclass(frozen=True)
class Block:
    """Lines of one system, measure and scene.

    Attributes
    ----------
    system : str
        Whose figures they are, as the paper names it.
    is_own : bool
        Whether that is the method that the paper proposes.
    incomparable : str
        Why the published figures and ours say nothing about each other; empty where
        they do.
    is_contest : bool
        Whether one of them can be better at all: statistics of data cannot.
    rebuilt_as : str
        How the system was built anew.
    rebuilt_is_same : bool
        Whether that is the system itself, and not another answer of ours to its task.
    """

    system: str
    measure: Measure
    lines: tuple[Line, ...]
    is_own: bool = False
    scene: str = ""
    incomparable: str = ""
    is_contest: bool = True
    rebuilt_as: str = ""
    rebuilt_is_same: bool = True

    @property
    def has_rebuilt(self) -> bool:
        """Whether any line has a figure of the system built anew."""
        return any(line.rebuilt is not None for line in self.lines)

    def verdict(self, line: Line) -> str:
        """Ours beside the published figure."""
        if self.incomparable or not self.is_contest:
            return APART
        return self.measure.compare(_number(line.ours), _number(line.published))

    def verdict_there(self, line: Line) -> str:
        """Ours beside the rebuilt system, in the same conditions."""
        if not (self.is_contest and self.rebuilt_is_same):
            return APART
        return self.measure.compare(_number(line.ours_there), _number(line.rebuilt))

    def counts(self, *, there: bool = False) -> Counter:
        """Count verdicts beside published figures, or beside systems built anew."""
        if not self.is_contest or (there and not self.rebuilt_is_same):
            return Counter()
        if not there:
            found = [self.verdict(n) for n in self.lines if n.published is not None]
            return Counter(found)
        return Counter(
            self.verdict_there(line)
            for line in self.lines
            if line.rebuilt is not None and line.ours_there is not None
        )


@dataclass(frozen=True)
class Section:
    """A table or figure of the paper.

    Attributes
    ----------
    number : str
        As "Table 7".
    shows : str
        What the paper shows there.
    finding : str
        What comes of the comparison, plainly.
    origins : tuple of str
        Results that ours are from, as "field".
    picture : str
        Name of a picture of ours among the results; empty where there is none.
    missing : str
        What is not measured, and why.
    """

    number: str
    title: str
    shows: str
    finding: str
    origins: tuple[str, ...]
    blocks: tuple[Block, ...] = ()
    picture: str = ""
    picture_says: str = ""
    missing: str = ""
    notes: tuple[str, ...] = field(default=())

    @property
    def anchor(self) -> str:
        """Name for links."""
        return self.number.lower().replace(" ", "-")


def _number(value: float | str | None) -> float | None:
    return None if isinstance(value, str) else value


def counts(sections: Iterable[Section], *, own: bool, there: bool = False) -> Counter:
    """Count verdicts of the paper's method, or of others', as `Block.counts`."""
    blocks = (block for section in sections for block in section.blocks)
    found = (block.counts(there=there) for block in blocks if block.is_own == own)
    return sum(found, Counter())
