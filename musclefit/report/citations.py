"""What a run stands on, as numbered references and BibTeX; knows works, not runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Work:
    """A paper or a program.

    Parameters
    ----------
    key : str
        Of BibTeX.
    authors : str
        As BibTeX writes them, parted by " and ".
    title : str
    where : str
        Journal, or what publishes a program.
    year : str
        "" where a program has none.
    more : mapping
        Further fields of BibTeX: volume, number, pages.
    doi, url : str
    """

    key: str
    authors: str
    title: str
    where: str
    year: str = ""
    more: Mapping[str, str] = field(default_factory=dict)
    doi: str = ""
    url: str = ""

    @property
    def words(self) -> str:
        """The reference as a list of references has it."""
        names = [name.split(", ")[0].strip("{}") for name in self.authors.split(" and ")]
        who = f"{names[0]} et al." if len(names) > 3 else ", ".join(names)
        pages = self.more.get("pages", "").replace("--", "–")
        numbers = ", ".join(filter(None, (self.more.get("volume", ""), pages)))
        year = f" ({self.year})" if self.year else ""
        place = f"doi:{self.doi}" if self.doi else self.url.removeprefix("https://")
        return f"{who}: {self.title}. {self.where} {numbers}".rstrip() + f"{year}." + (f" {place}" if place else "")

    def bibtex(self, *, version: str = "") -> str:
        """The entry; the version of what was used goes into its note."""
        kind, within = ("article", "journal") if self.doi else ("misc", "howpublished")
        if self.where.startswith("Proceedings"):
            kind, within = "inproceedings", "booktitle"
        fields = {"author": self.authors, "title": f"{{{self.title}}}", within: self.where, "year": self.year}
        fields |= {**self.more, "doi": self.doi, "url": self.url, "note": _plain(version)}
        lines = [f"  {name} = {{{value.replace('&', chr(92) + '&')}}}," for name, value in fields.items() if value]
        return "\n".join([f"@{kind}{{{self.key},", *lines, "}"])


def _plain(version: str) -> str:
    """A version without what would end a field."""
    return "".join(c for c in version if c.isalnum() or c in ".+-_ ")


def _volume(volume: str, number: str = "", pages: str = "") -> Mapping[str, str]:
    return MappingProxyType({k: v for k, v in (("volume", volume), ("number", number), ("pages", pages)) if v})


WORKS: Mapping[str, Work] = MappingProxyType(
    {
        work.key: work
        for work in (
            Work("musclefit", "{The musclefit developers}", "musclefit", "Software, Apache-2.0"),
            Work(
                "yu2014foldover",
                "Yu, Hongchuan and Zhang, Jian J. and Lee, Tong-Yee",
                "Foldover-free shape deformation for biomedicine",
                "Journal of Biomedical Informatics",
                "2014",
                _volume("48", "", "137--147"),
                "10.1016/j.jbi.2013.12.011",
            ),
            Work(
                "narcowich1994generalized",
                "Narcowich, Francis J. and Ward, Joseph D.",
                "Generalized Hermite interpolation via matrix-valued conditionally positive definite functions",
                "Mathematics of Computation",
                "1994",
                _volume("63", "208", "661--687"),
                "10.1090/S0025-5718-1994-1254147-6",
            ),
            Work(
                "bookstein1989principal",
                "Bookstein, Fred L.",
                "Principal warps: thin-plate splines and the decomposition of deformations",
                "IEEE Transactions on Pattern Analysis and Machine Intelligence",
                "1989",
                _volume("11", "6", "567--585"),
                "10.1109/34.24792",
            ),
            Work(
                "wendland1995piecewise",
                "Wendland, Holger",
                "Piecewise polynomial, positive definite and compactly supported radial functions of minimal degree",
                "Advances in Computational Mathematics",
                "1995",
                _volume("4", "", "389--396"),
                "10.1007/BF02123482",
            ),
            Work(
                "sederberg1986free",
                "Sederberg, Thomas W. and Parry, Scott R.",
                "Free-form deformation of solid geometric models",
                "ACM SIGGRAPH Computer Graphics",
                "1986",
                _volume("20", "4", "151--160"),
                "10.1145/15886.15903",
            ),
            Work(
                "hu2020fast",
                "Hu, Yixin and Schneider, Teseo and Wang, Bolun and Zorin, Denis and Panozzo, Daniele",
                "Fast tetrahedral meshing in the wild",
                "ACM Transactions on Graphics",
                "2020",
                _volume("39", "4", "117"),
                "10.1145/3386569.3392385",
            ),
            Work(
                "shewchuk1997adaptive",
                "Shewchuk, Jonathan Richard",
                "Adaptive precision floating-point arithmetic and fast robust geometric predicates",
                "Discrete & Computational Geometry",
                "1997",
                _volume("18", "3", "305--363"),
                "10.1007/PL00009321",
            ),
            Work(
                "manifold",
                "Lalish, Emmett",
                "Manifold: a geometry library for topological robustness",
                "Software",
                url="https://github.com/elalish/manifold",
            ),
            Work(
                "harris2020array",
                "Harris, Charles R. and Millman, K. Jarrod and van der Walt, Stéfan J. and others",
                "Array programming with NumPy",
                "Nature",
                "2020",
                _volume("585", "", "357--362"),
                "10.1038/s41586-020-2649-2",
            ),
            Work(
                "virtanen2020scipy",
                "Virtanen, Pauli and Gommers, Ralf and Oliphant, Travis E. and others",
                "SciPy 1.0: fundamental algorithms for scientific computing in Python",
                "Nature Methods",
                "2020",
                _volume("17", "", "261--272"),
                "10.1038/s41592-019-0686-2",
            ),
            Work(
                "lam2015numba",
                "Lam, Siu Kwan and Pitrou, Antoine and Seibert, Stanley",
                "Numba: a LLVM-based Python JIT compiler",
                "Proceedings of the Second Workshop on the LLVM Compiler Infrastructure in HPC",
                "2015",
                _volume("", "", "1--6"),
                "10.1145/2833157.2833162",
            ),
            Work(
                "sullivan2019pyvista",
                "Sullivan, C. Bane and Kaszynski, Alexander A.",
                "PyVista: 3D plotting and mesh analysis through a streamlined interface for the Visualization Toolkit",
                "Journal of Open Source Software",
                "2019",
                _volume("4", "37", "1450"),
                "10.21105/joss.01450",
            ),
        )
    }
)
"""By key of BibTeX."""
