"""`drgs cite`: BibTeX of what a run rests on, or of what every use does.

A work is an entry of `_WORKS`; whether a run used it is read from its config.json and metrics.json alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from drgs.guards.json_files import read_json
from drgs.runtime import version

if TYPE_CHECKING:
    from drgs.commands.options import Cite
    from drgs.fitting.config import SelectionConfig
    from drgs.fitting.records import FitRecord

__all__ = ["cited", "run"]


class _Used(NamedTuple):
    """What a run did, as far as it says what to cite.

    Attributes:
        record: Of its fit.
        format: Of its data set.
        selection: How views were chosen; of a run that chose none, None.
        lpips: Whether LPIPS was measured.
    """

    record: FitRecord
    format: str
    selection: SelectionConfig | None
    lpips: bool

    def chose(self, *policies: str) -> bool:
        """Whether views were chosen by one of these policies."""
        return self.selection is not None and self.selection.policy in policies

    def scored(self, *criteria: str) -> bool:
        """Whether policy `fisher` scored by one of these criteria."""
        return self.chose("fisher") and self.selection is not None and self.selection.scoring.criterion in criteria


class _Work(NamedTuple):
    """A work to cite.

    Attributes:
        why: What of it is used, one line.
        used: Whether a run used it; None: every use does.
        kind, key: Of the entry.
        fields: Of the entry. What is not known for certain is left out.
    """

    why: str
    used: Callable[[_Used], bool] | None
    kind: str
    key: str
    fields: dict[str, str]


_TOG = "ACM Transactions on Graphics"
_CVPR = "IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)"
_NEURIPS = "Advances in Neural Information Processing Systems (NeurIPS)"

_WORKS = (
    _Work(
        "this program",
        None,
        "software",
        "drgs",
        {
            "author": "{The drgs authors}",
            "title": "drgs: differentiable rendering of 3D Gaussians with Dr.Jit and Mitsuba 3",
            "version": version(),
        },
    ),
    _Work(
        "compiles and differentiates every kernel",
        None,
        "article",
        "jakob2022drjit",
        {
            "author": "Jakob, Wenzel and Speierer, S{\\'e}bastien and Roussel, Nicolas and Vicini, Delio",
            "title": "{Dr.Jit}: A Just-In-Time Compiler for Differentiable Rendering",
            "journal": _TOG,
            "volume": "41",
            "number": "4",
            "year": "2022",
            "doi": "10.1145/3528223.3530099",
        },
    ),
    _Work(
        "traces rays through the acceleration structure, and is what `drgs` plugs into",
        None,
        "software",
        "mitsuba3",
        {
            "author": "Jakob, Wenzel and Speierer, S{\\'e}bastien and Roussel, Nicolas and Nimier-David, Merlin and "
            "Vicini, Delio and Zeltner, Tizian and Nicolet, Baptiste and Crespo, Miguel and Leroy, Vincent and "
            "Zhang, Ziyi",
            "title": "{Mitsuba 3} renderer",
            "year": "2022",
            "url": "https://mitsuba-renderer.org",
        },
    ),
    _Work(
        "the scene representation, its losses and its schedule",
        None,
        "article",
        "kerbl2023gaussians",
        {
            "author": 'Kerbl, Bernhard and Kopanas, Georgios and Leimk{\\"u}hler, Thomas and Drettakis, George',
            "title": "{3D} {Gaussian} Splatting for Real-Time Radiance Field Rendering",
            "journal": _TOG,
            "volume": "42",
            "number": "4",
            "year": "2023",
        },
    ),
    _Work(
        "what the derivatives are for: views chosen by Fisher information, of semantic and moving scenes, too",
        None,
        "article",
        "li2025nextbestview",
        {
            "author": "Li, Yiqian and Jiang, Wen and Daniilidis, Kostas",
            "title": "Next Best View Selections for Semantic and Dynamic {3D} {Gaussian} Splatting",
            "journal": "arXiv preprint arXiv:2512.22771",
            "year": "2025",
        },
    ),
    _Work(
        "density control of the fit",
        lambda used: True,
        "inproceedings",
        "kheradmand2024mcmc",
        {
            "author": "Kheradmand, Shakiba and Rebain, Daniel and Sharma, Gopal and Sun, Weiwei and Tseng, Yang-Che "
            "and Isack, Hossam and Kar, Abhishek and Tagliasacchi, Andrea and Yi, Kwang Moo",
            "title": "{3D} {Gaussian} Splatting as {Markov} Chain {Monte} {Carlo}",
            "booktitle": _NEURIPS,
            "year": "2024",
        },
    ),
    _Work(
        "response `peak`: the opacity where a ray comes nearest to a Gaussian",
        lambda used: used.record.config.settings.response == "peak",
        "article",
        "moenneloccoz2024raytracing",
        {
            "author": "Moenne-Loccoz, Nicolas and Mirzaei, Ashkan and Perel, Or and de Lutio, Riccardo and "
            "Martinez Esturo, Janick and State, Gavriel and Fidler, Sanja and Sharp, Nicholas and Gojcic, Zan",
            "title": "{3D} {Gaussian} Ray Tracing: Fast Tracing of Particle Scenes",
            "journal": _TOG,
            "volume": "43",
            "number": "6",
            "year": "2024",
        },
    ),
    _Work(
        "response `ewa`: the projected covariance",
        lambda used: used.record.config.settings.response == "ewa",
        "inproceedings",
        "zwicker2001ewa",
        {
            "author": "Zwicker, Matthias and Pfister, Hanspeter and van Baar, Jeroen and Gross, Markus",
            "title": "{EWA} Volume Splatting",
            "booktitle": "IEEE Visualization",
            "year": "2001",
        },
    ),
    _Work(
        "conventions of preset `gsplat`: its clamp, culling and stop rule",
        lambda used: "gsplat" in (used.record.config.settings.fov_clamp, used.record.config.settings.culling),
        "article",
        "ye2025gsplat",
        {
            "author": "Ye, Vickie and Li, Ruilong and Kerr, Justin and Turkulainen, Matias and Yi, Brent and "
            "Pan, Zhuoyang and Seiskari, Otto and Ye, Jianbo and Hu, Jeffrey and Tancik, Matthew and Kanazawa, Angjoo",
            "title": "gsplat: An Open-Source Library for {Gaussian} Splatting",
            "journal": "Journal of Machine Learning Research",
            "volume": "26",
            "number": "34",
            "year": "2025",
        },
    ),
    _Work(
        "poses and points of the photographs",
        lambda used: used.format == "colmap",
        "inproceedings",
        "schoenberger2016sfm",
        {
            "author": 'Sch{\\"o}nberger, Johannes Lutz and Frahm, Jan-Michael',
            "title": "Structure-from-Motion Revisited",
            "booktitle": "IEEE Conference on Computer Vision and Pattern Recognition (CVPR)",
            "year": "2016",
        },
    ),
    _Work(
        "features of a teacher, distilled",
        lambda used: used.record.semantics is not None,
        "inproceedings",
        "zhou2024feature3dgs",
        {
            "author": "Zhou, Shijie and Chang, Haoran and Jiang, Sicheng and Fan, Zhiwen and Zhu, Zehao and "
            "Xu, Dejia and Chari, Pradyumna and You, Suya and Wang, Zhangyang and Kadambi, Achuta",
            "title": "Feature {3DGS}: Supercharging {3D} {Gaussian} Splatting to Enable Distilled Feature Fields",
            "booktitle": _CVPR,
            "year": "2024",
        },
    ),
    _Work(
        "the deformation field and its two stages",
        lambda used: bool(used.record.times),
        "inproceedings",
        "wu2024fourd",
        {
            "author": "Wu, Guanjun and Yi, Taoran and Fang, Jiemin and Xie, Lingxi and Zhang, Xiaopeng and Wei, Wei "
            "and Liu, Wenyu and Tian, Qi and Wang, Xinggang",
            "title": "{4D} {Gaussian} Splatting for Real-Time Dynamic Scene Rendering",
            "booktitle": _CVPR,
            "year": "2024",
        },
    ),
    _Work(
        "Fisher information that chose views: criterion `eig`, policy and method `fisherrf`",
        lambda used: (
            used.chose("fisherrf")
            or used.scored("eig")
            or (used.chose("fisher") and used.selection is not None and used.selection.scoring.method == "fisherrf")
        ),
        "inproceedings",
        "jiang2024fisherrf",
        {
            "author": "Jiang, Wen and Lei, Boshu and Daniilidis, Kostas",
            "title": "{FisherRF}: Active View Selection and Mapping with Radiance Fields Using {Fisher} Information",
            "booktitle": "European Conference on Computer Vision (ECCV)",
            "year": "2024",
        },
    ),
    _Work(
        "criteria `logdet`, `trace_cov` and `block_logdet` that chose views",
        lambda used: used.scored("logdet", "trace_cov", "block_logdet"),
        "inproceedings",
        "wilson2025popgs",
        {
            "author": "Wilson, Joey and Almeida, Marcelino and Mahajan, Sachit and Labrie, Martin and "
            "Ghaffari, Maani and Ghasemalizadeh, Omid and Sun, Min and Kuo, Cheng-Hao and Sen, Arnab",
            "title": "{POp-GS}: Next Best View in {3D}-{Gaussian} Splatting with {P}-Optimality",
            "booktitle": _CVPR,
            "year": "2025",
        },
    ),
    _Work(
        "criterion `v_opt` that chose views: the error of a pool, as in batch active learning",
        lambda used: used.scored("v_opt"),
        "inproceedings",
        "ash2021bait",
        {
            "author": "Ash, Jordan T. and Goel, Surbhi and Krishnamurthy, Akshay and Kakade, Sham",
            "title": "Gone Fishing: Neural Active Learning with {Fisher} Embeddings",
            "booktitle": _NEURIPS,
            "year": "2021",
        },
    ),
    _Work(
        "policy `moments` that chose views",
        lambda used: used.chose("moments"),
        "article",
        "ewen2025moments",
        {
            "author": "Ewen, Parker and Chen, Hao and Isaacson, Seth and Wilson, Joey and Skinner, Katherine A. and "
            "Vasudevan, Ram",
            "title": "These Magic Moments: Differentiable Uncertainty Quantification of Radiance Field Models",
            "journal": "arXiv preprint arXiv:2503.14665",
            "year": "2025",
        },
    ),
    _Work(
        "SSIM: in the loss and in metrics.json",
        lambda used: True,
        "article",
        "wang2004ssim",
        {
            "author": "Wang, Zhou and Bovik, Alan C. and Sheikh, Hamid R. and Simoncelli, Eero P.",
            "title": "Image Quality Assessment: From Error Visibility to Structural Similarity",
            "journal": "IEEE Transactions on Image Processing",
            "volume": "13",
            "number": "4",
            "year": "2004",
        },
    ),
    _Work(
        "FLIP in metrics.json",
        lambda used: True,
        "article",
        "andersson2020flip",
        {
            "author": 'Andersson, Pontus and Nilsson, Jim and Akenine-M{\\"o}ller, Tomas and Oskarsson, Magnus and '
            '{\\AA}str{\\"o}m, Kalle and Fairchild, Mark D.',
            "title": "{FLIP}: A Difference Evaluator for Alternating Images",
            "journal": "Proceedings of the ACM on Computer Graphics and Interactive Techniques",
            "volume": "3",
            "number": "2",
            "year": "2020",
            "doi": "10.1145/3406183",
        },
    ),
    _Work(
        "LPIPS in metrics.json",
        lambda used: used.lpips,
        "inproceedings",
        "zhang2018lpips",
        {
            "author": "Zhang, Richard and Isola, Phillip and Efros, Alexei A. and Shechtman, Eli and Wang, Oliver",
            "title": "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
            "booktitle": "IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)",
            "year": "2018",
        },
    ),
)


def run(args: Cite) -> None:
    """`drgs cite [RUN]`."""
    print(cited(args.run))


def cited(folder: Path | None) -> str:
    """BibTeX of what a run used; without one, of what every use does.

    Args:
        folder: The run folder.
    Raises:
        FileNotFoundError: If it is none.
        ValueError: If its config.json is damaged.
    """
    used = None if folder is None else _used(folder)
    works = [work for work in _WORKS if work.used is None or (used is not None and work.used(used))]
    return "\n\n".join(_entry(work) for work in works)


def _used(folder: Path) -> _Used:
    """What a run did; it need not have come to its end."""
    from drgs.files import Run  # loads torch, which a list without a run does not need
    from drgs.fitting.records import fit_record

    run = Run(folder)
    record = fit_record(run)
    path = run.path / "metrics.json"
    metrics: Any = read_json(path, "a run's metrics.json") if path.is_file() else {}
    mean = metrics.get("mean") if isinstance(metrics, dict) else None
    lpips = isinstance(mean, dict) and mean.get("lpips") is not None
    return _Used(record, str(run.config().get("format", "")), record.config.selection, lpips)


def _entry(work: _Work) -> str:
    fields = "".join(f"  {name} = {{{value}}},\n" for name, value in work.fields.items())
    return f"% {work.why}\n@{work.kind}{{{work.key},\n{fields}}}"
