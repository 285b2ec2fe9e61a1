"""Information gain: definitions, invariances, lambda = 0, and the chain from mutual information to the diagonal."""

from __future__ import annotations

import math

import dense_jacobian
import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians
from torch.utils._python_dispatch import TorchDispatchMode

from drgs import reference
from drgs.gain import (
    BLOCK_LAYOUT,
    CRITERIA,
    Gain,
    Prior,
    block_gain,
    check,
    dense,
    information_gain,
    scorer,
    variances,
)
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

DIAGONAL = tuple(name for name in CRITERIA if name != "block_logdet")


def random_information(rng, n=40, K=4, seen=0.7):
    """As `fisher.diagonal` gives it: many powers of ten, and zeros for what is not seen."""
    shapes = {"means": (n, 3), "rotations": (n, 3), "log_scales": (n, 3), "logit_opacities": (n,), "sh": (n, K, 3)}
    scales = {"means": 1e4, "rotations": 10, "log_scales": 100, "logit_opacities": 1, "sh": 5}
    there = torch.tensor(rng.uniform(size=n) < seen)
    return {
        name: scales[name]
        * torch.tensor(np.exp(3 * rng.normal(size=shape)))
        * there.reshape(-1, *[1] * (len(shape) - 1))
        for name, shape in shapes.items()
    }


def gain_of(Hc, H, criterion, prior=None, pool=None):
    """`information_gain`; of `v_opt` for a pool that sees what the training views see, unless another one is given."""
    return information_gain(Hc, H, criterion, prior, pool=(pool or H) if criterion == "v_opt" else None)


def random_blocks(rng, n=20, rows=40):
    """Sums of outer products, the units of the parameters far apart."""
    J = torch.tensor(rng.normal(size=(n, rows, 13)) * 10 ** rng.uniform(-2, 2, (1, 1, 13)))
    return J.mT @ J


def views(rng, count=4, n=8):
    """Dense Jacobians (3 P, 13 N) of random views of one small scene, the labels of their columns, and groups."""
    settings = RenderSettings.preset("exact")
    g = gaussians(rng, n, 1, scale=0.25)
    parts = [
        dense_jacobian.jacobian(g, reference.render(g, camera(rng, (12, 10), turn=0.5), settings)) for _ in range(count)
    ]
    rows = [dense_jacobian.stacked(J) for J in parts]
    return [J.reshape(len(J), -1) for J in rows], torch.arange(13 * n) // 13, [dense_jacobian.squares(J) for J in parts]


# -------------------------------------------------- definitions


def test_definitions(rng):
    """Each criterion against its formula, written as loops."""
    H, Hc, P = random_information(rng), random_information(rng), random_information(rng)
    prior = Prior(1e-3, groups={"means": 10.0})
    formulas = {
        "eig": lambda h, c, lam, p: c / (h + lam),
        "logdet": lambda h, c, lam, p: math.log1p(c / (h + lam)),
        "trace_cov": lambda h, c, lam, p: 1 / (h + lam) - 1 / (h + c + lam),
        "v_opt": lambda h, c, lam, p: p * (1 / (h + lam) - 1 / (h + c + lam)),
    }
    for criterion, formula in formulas.items():
        gain = information_gain(Hc, H, criterion, prior, {"sh": 0.5}, P if criterion == "v_opt" else None)
        for name in H:
            lam = 10.0 if name == "means" else 1e-3
            triples = zip(*(x[name].flatten().tolist() for x in (H, Hc, P)), strict=True)
            values = [(formula(h, c, lam, p), h) for h, c, p in triples]
            factor = 0.5 if name == "sh" else 1.0
            assert gain.parts[name] == pytest.approx(factor * math.fsum(v for v, _ in values), rel=1e-9)
            assert gain.unseen[name] == pytest.approx(factor * math.fsum(v for v, h in values if h == 0), rel=1e-9)
        assert gain.total == pytest.approx(sum(gain.parts.values()), rel=1e-12)
        assert gain.left_out == dict.fromkeys(H, 0)


def test_trace_cov_keeps_small_gains():
    """A candidate that adds 1e-20 of what is known: the difference of the two variances would be 0."""
    H, Hc = {"means": torch.full((1, 3), 1.0).double()}, {"means": torch.full((1, 3), 1e-20).double()}
    assert information_gain(Hc, H, "trace_cov", Prior(0.0)).total == pytest.approx(3e-20, rel=1e-12)


def test_prior():
    """Absolute, per group, and relative to the median of what is positive."""
    H = {"means": torch.tensor([0.0, 1.0, 3.0, 100.0]).double(), "sh": torch.zeros(3).double()}
    assert Prior(0.5, groups={"sh": 2}).per_group(H) == {"means": 0.5, "sh": 2.0}
    assert Prior(0.5, relative=True).per_group(H) == {"means": 1.5, "sh": 0.0}
    assert Prior(np.float32(0.5)).to_json() == {"value": 0.5, "relative": False, "length": None} == Prior(0.5).to_json()
    assert type(Prior(np.float32(0.5)).value) is float
    found = variances(H, Prior(0.5, relative=True))
    assert found["means"].tolist() == pytest.approx([1 / 1.5, 1 / 2.5, 1 / 4.5, 1 / 101.5])
    assert found["sh"].tolist() == [0, 0, 0]


# -------------------------------------------------- invariances


@pytest.mark.parametrize("criterion", CRITERIA)
def test_permutation(rng, criterion):
    """The order of the Gaussians plays no role."""
    order = torch.randperm(40)
    if criterion == "block_logdet":
        H, Hc = ({"blocks": random_blocks(rng, 40)} for _ in range(2))
    else:
        H, Hc = random_information(rng), random_information(rng)
    one = gain_of(Hc, H, criterion)
    turned = ({name: x[order] for name, x in y.items()} for y in (Hc, H))
    two = gain_of(*turned, criterion)
    assert two.total == pytest.approx(one.total, rel=1e-12)
    assert two.parts == pytest.approx(one.parts, rel=1e-12)


@pytest.mark.parametrize("criterion", ["eig", "logdet", "v_opt"])
def test_units(rng, criterion):
    """Seen parameters: as lambda -> 0 a group's unit stops mattering, linearly in lambda; a relative one never does."""
    H, Hc = random_information(rng, seen=1.0), random_information(rng)
    unit = 37.0  # meters to something else: derivatives are divided, information by the square
    other = [{name: x / unit**2 if name == "means" else x for name, x in y.items()} for y in (Hc, H)]
    differences = []
    for value in (1e-4, 1e-6, 1e-8, 0.0):
        gains = [gain_of(*pair, criterion, Prior(value)).total for pair in ((Hc, H), other)]
        differences.append(abs(gains[1] / gains[0] - 1))
    assert differences[0] > 1e-6
    assert differences[1] < 0.1 * differences[0]
    assert differences[2] < 0.02 * differences[1]
    assert differences[3] < 1e-12
    relative = [gain_of(*pair, criterion, Prior(1e-2, relative=True)).total for pair in ((Hc, H), other)]
    assert relative[1] == pytest.approx(relative[0], rel=1e-12)


def test_units_of_unseen_parameters_matter(rng):
    """Why the test above speaks of seen ones: an absolute lambda is all that is known of the others."""
    H, Hc = random_information(rng, seen=0.5), random_information(rng)
    other = [{name: x / 37.0**2 if name == "means" else x for name, x in y.items()} for y in (Hc, H)]
    gains = [information_gain(*pair, "eig", Prior(1e-6)) for pair in ((Hc, H), other)]
    assert gains[1].parts["means"] / gains[0].parts["means"] == pytest.approx(1 / 37.0**2, rel=1e-2)
    assert gains[0].unseen["means"] / gains[0].parts["means"] > 0.999


def test_units_of_blocks(rng):
    """Whole blocks may be expressed in any coordinates, once lambda and rounding are small."""
    H, Hc = random_blocks(rng), random_blocks(rng)
    turn = torch.tensor(rng.normal(size=(13, 13))) + 3 * torch.eye(13)
    one = block_gain(Hc, H, Prior(0.0), rounding=0.0).total
    assert block_gain(turn.T @ Hc @ turn, turn.T @ H @ turn, Prior(0.0), rounding=0.0).total == pytest.approx(
        one, rel=1e-8
    )


def test_more_information_gains_less(rng):
    """Diminishing returns, what lazy greedy selection rests on: every criterion falls as H grows."""
    for _ in range(5):
        H, more, Hc = random_information(rng), random_information(rng), random_information(rng)
        later = {name: H[name] + more[name] for name in H}
        for criterion in DIAGONAL:
            before, after = (gain_of(Hc, known, criterion, pool=more).total for known in (H, later))
            assert after < before
        H, more, Hc = random_blocks(rng, rows=5), random_blocks(rng, rows=5), random_blocks(rng, rows=5)
        assert block_gain(Hc, H + more).total < block_gain(Hc, H).total


# -------------------------------------------------- lambda = 0, and what is wrong


def test_lambda_zero(rng):
    """Parameters without training information are left out and counted; nothing is NaN, also where 0 meets 0."""
    H, Hc = random_information(rng, seen=0.5), random_information(rng, seen=0.5)
    for criterion in DIAGONAL:
        gain = gain_of(Hc, H, criterion, Prior(0.0))
        assert gain.left_out == {name: int((x == 0).sum()) for name, x in H.items()}
        assert sum(gain.left_out.values()) > 0
        assert set(gain.unseen.values()) == {0.0}
        seen = {name: x > 0 for name, x in H.items()}
        pairs = ({name: y[name][seen[name]] for name in H} for y in (Hc, H))
        assert gain.total == pytest.approx(gain_of(*pairs, criterion, Prior(0.0)).total, rel=1e-12)
    nothing = {name: torch.zeros_like(x) for name, x in H.items()}
    assert information_gain(Hc, nothing, "eig", Prior(0.0)).total == 0
    assert information_gain(nothing, H, "logdet", Prior(0.0)).total == 0
    mixed = information_gain(Hc, H, "eig", Prior(1e-6, groups={"means": 0.0})).left_out
    assert mixed == {**dict.fromkeys(H, 0), "means": int((H["means"] == 0).sum())}


def test_lambda_zero_blocks(rng):
    """The same for blocks: rows of unseen parameters drop out, unseen Gaussians gain nothing."""
    H, Hc = random_blocks(rng), random_blocks(rng)
    H[:5] = 0  # never seen
    H[5, 3:6], H[5, :, 3:6] = 0, 0  # a sphere: its rotations change nothing
    gain = block_gain(Hc, H, Prior(0.0), rounding=0.0)
    assert gain.left_out == {"means": 15, "rotations": 18, "log_scales": 15, "logit_opacities": 5, "sh": 15}
    keep = [k for k in range(13) if k not in (3, 4, 5)]
    expected = block_gain(Hc[6:], H[6:], Prior(0.0), rounding=0.0).total + block_gain(
        Hc[5:6][:, keep][:, :, keep], H[5:6][:, keep][:, :, keep], Prior(0.0), {"all": slice(0, 10)}, rounding=0.0
    ).total  # fmt: skip
    assert gain.total == pytest.approx(expected, rel=1e-10)


def test_singular_blocks(rng):
    """float32 sums of fewer rows than parameters: the gain is finite, near the truth, repaired where indefinite."""
    J = torch.tensor(rng.normal(size=(30, 6, 13)) * 10 ** rng.uniform(-2, 2, (1, 1, 13)))
    Jc = torch.tensor(rng.normal(size=(30, 6, 13)) * 10 ** rng.uniform(-2, 2, (1, 1, 13)))
    H, Hc = J.mT @ J, Jc.mT @ Jc
    exact = block_gain(Hc, H, Prior(1e-3), rounding=0.0).total
    rough = block_gain(Hc.float(), H.float(), Prior(1e-3))
    assert rough.total == pytest.approx(exact, rel=1e-2)
    worse = H * (1 + 1e-4 * torch.tensor(rng.normal(size=H.shape)).tril().abs())
    repaired = block_gain(Hc, worse, Prior(0.0))
    assert repaired.repaired > 0
    assert math.isfinite(repaired.total)
    with pytest.raises(ValueError, match="block_gain: H \\+ lambda must be positive definite"):
        block_gain(Hc, 2 * torch.ones(30, 13, 13) - torch.eye(13), Prior(1e-6))


class _Largest(TorchDispatchMode):
    """Bytes of the largest tensor that is made."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for x in made if isinstance(made, tuple) else (made,):
            if isinstance(x, torch.Tensor) and not x._is_view():
                self.bytes = max(self.bytes, x.nbytes)
        return made


def test_blocks_are_scored_some_at_a_time(rng):
    """In memory that does not grow with their number, to the bits of each alone; a bad one is named by its place."""
    few = 100
    H, Hc = (random_blocks(rng, few).float().repeat(100, 1, 1) for _ in range(2))
    with _Largest() as largest:
        gain = block_gain(Hc, H, Prior(1e-3))
    assert largest.bytes < 8 * 169 * len(H) / 2
    assert gain.total == pytest.approx(100 * block_gain(Hc[:few], H[:few], Prior(1e-3)).total, rel=1e-12)
    H[-3] = 2 - torch.eye(13)
    with pytest.raises(ValueError, match=f"is not for Gaussian {len(H) - 3}; raise lambda"):
        block_gain(Hc, H, Prior(1e-6))


def test_empty():
    """No Gaussians: nothing to gain."""
    none = {"means": torch.zeros(0, 3).double(), "sh": torch.zeros(0, 1, 3).double()}
    for criterion in DIAGONAL:
        assert gain_of(none, none, criterion) == Gain(
            0.0, {"means": 0.0, "sh": 0.0}, {"means": 0, "sh": 0}, {"means": 0.0, "sh": 0.0}
        )
    assert block_gain(torch.zeros(0, 13, 13), torch.zeros(0, 13, 13)).total == 0


def test_errors(rng):
    """One line each, that says what was got."""
    H, Hc = random_information(rng), random_information(rng)
    bad = {**Hc, "means": Hc["means"].clone()}
    bad["means"][7, 2] = math.nan
    with pytest.raises(
        ValueError, match=r"candidate: information must be finite and >= 0, got nan in means at \(7, 2\)"
    ):
        information_gain(bad, H, "eig")
    bad["means"][7, 2] = -1
    with pytest.raises(ValueError, match=r"train: information must be finite and >= 0, got -1 in means at \(7, 2\)"):
        information_gain(Hc, bad, "eig")
    with pytest.raises(
        ValueError, match=r"information_gain: pool: information must be finite and >= 0, got -1 in means"
    ):
        information_gain(Hc, H, "v_opt", pool=bad)
    bad["means"][7, 2] = math.inf
    with pytest.raises(ValueError, match=r"got inf in means at \(7, 2\) \(1 of 120 entries\)"):
        check("here", bad)
    with pytest.raises(ValueError, match=r"eig must be finite, got .*means.*inf"):
        scorer(H, "eig")(bad)
    with pytest.raises(ValueError, match="criterion must be one of v_opt, eig"):
        information_gain(Hc, H, "D-opt")
    with pytest.raises(ValueError, match="pool must be None with criterion eig, got one"):
        information_gain(Hc, H, "eig", pool=H)
    with pytest.raises(ValueError, match="pool must be given with criterion v_opt, got none"):
        information_gain(Hc, H, "v_opt")
    with pytest.raises(ValueError, match="candidate must have the groups of train"):
        information_gain({"means": Hc["means"]}, H, "eig")
    with pytest.raises(ValueError, match=r"means must have the shape of train, \(40, 3\), got \(39, 3\)"):
        information_gain({**Hc, "means": Hc["means"][1:]}, H, "eig")
    with pytest.raises(ValueError, match="weights must be of means, .*, got 'colour'"):
        information_gain(Hc, H, "eig", weights={"colour": 1})
    with pytest.raises(ValueError, match=r"weight of sh must be in \[0, inf\), got -1"):
        information_gain(Hc, H, "eig", weights={"sh": -1})
    with pytest.raises(ValueError, match="Prior: groups must be among means, .*, got 'colour'"):
        information_gain(Hc, H, "eig", prior=Prior(groups={"colour": 1}))
    for value in (-1e-6, math.nan, math.inf, "1"):
        with pytest.raises(ValueError, match=r"Prior: lambda \(value\) must be in \[0, inf\)"):
            Prior(value)
    with pytest.raises(ValueError, match="weights must be None for block_logdet"):
        scorer({"blocks": random_blocks(rng)}, "block_logdet", weights={"sh": 0})
    with pytest.raises(ValueError, match="layout must cover 0..12 once"):
        block_gain(random_blocks(rng), random_blocks(rng), layout={"all": slice(0, 12)})
    with pytest.raises(ValueError, match=r"candidate must have the shape of train, \(20, 13, 13\), got \(19, 13, 13\)"):
        block_gain(random_blocks(rng, 19), random_blocks(rng))
    with pytest.raises(ValueError, match=r"train must have shape \(N, B, B\), got \(3, 4\)"):
        block_gain(torch.zeros(3, 4), torch.zeros(3, 4))


@pytest.mark.parametrize("value", [math.nan, math.inf, -5.0])
@pytest.mark.parametrize("criterion", CRITERIA)
def test_what_is_broken_is_not_known(rng, criterion, value):
    """Nobody has checked before: NaN, inf or a negative entry of H is no perfectly known parameter, and NaN or inf of a
    candidate no gain.
    """
    if criterion == "block_logdet":
        H, name, place = {"blocks": random_blocks(rng)}, "blocks", (3, 4, 4)
    else:
        H, name, place = random_information(rng), "means", (3, 2)
    bad = {**H, name: H[name].clone()}
    bad[name][place] = value
    pool = H if criterion == "v_opt" else None
    with pytest.raises(ValueError, match=r"must be (finite|positive definite)"):
        scorer(bad, criterion, pool=pool)(H)
    if math.isinf(value) or math.isnan(value):
        with pytest.raises(ValueError, match=r"must be (finite|positive definite)"):
            scorer(H, criterion, pool=pool)(bad)
    if name == "means":
        with pytest.raises(ValueError, match=rf"must be finite and >= 0, got {value:g} in means at \(3, 2\)"):
            variances(bad)


# -------------------------------------------------- the chain


def test_blocks_definition(rng):
    """Against numpy's determinants."""
    H, Hc, prior = random_blocks(rng), random_blocks(rng), Prior(0.1, groups={"means": 3.0})
    L = np.diag([3.0] * 3 + [0.1] * 10)
    expected = sum(
        np.linalg.slogdet(np.eye(13) + np.linalg.solve(h + L, c))[1] for h, c in zip(H.numpy(), Hc.numpy(), strict=True)
    )
    assert block_gain(Hc, H, prior, rounding=0.0).total == pytest.approx(expected, rel=1e-9)
    diagonal = [{name: x.diagonal(dim1=1, dim2=2)[:, place] for name, place in BLOCK_LAYOUT.items()} for x in (Hc, H)]
    only = [torch.diag_embed(x.diagonal(dim1=1, dim2=2)) for x in (Hc, H)]
    assert block_gain(*only, prior, rounding=0.0).total == pytest.approx(
        information_gain(*diagonal, "logdet", prior).total, rel=1e-9
    )


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("value", [1e-6, 1e-3, 1.0])
def test_chain(seed, value):
    """On real Jacobians: mutual information <= its trace bound, and all forms agree with their definitions."""
    rng = np.random.default_rng(seed)
    J, labels, squares = views(rng)
    H, Hc = torch.cat(J[:2]), J[3]
    chain = dense(Hc, H, value, labels)
    P = H.shape[1]
    full, new = H.T @ H + value * torch.eye(P), Hc.T @ Hc
    exact = 0.5 * (torch.linalg.slogdet(full + new)[1] - torch.linalg.slogdet(full)[1])
    assert chain.mutual_information == pytest.approx(float(exact), rel=1e-6)
    assert chain.trace_bound == pytest.approx(0.5 * float(torch.linalg.solve(full, new).trace()), rel=1e-4)
    assert chain.mutual_information <= chain.trace_bound
    assert chain.left_out == 0
    train = {name: squares[0][name] + squares[1][name] for name in squares[0]}
    for criterion in ("logdet", "eig"):
        gain = information_gain(squares[3], train, criterion, Prior(value))
        assert 0.5 * gain.total == pytest.approx(getattr(chain, criterion), rel=1e-9)
    blocks = [torch.einsum("mni,mnj->nij", x, x) for x in (Hc.reshape(len(Hc), -1, 13), H.reshape(len(H), -1, 13))]
    gain = block_gain(*blocks, Prior(value), rounding=0.0)
    assert 0.5 * gain.total == pytest.approx(chain.block_logdet, rel=1e-8)
    # Only a product of determinants bounds: independence never lowers the entropy before or after, so that neither
    # approximation is above or below for certain. What they are is measured in docs/information.md.
    assert chain.logdet <= chain.eig


def test_chain_lambda_zero(rng):
    """What no training row moves is left out; what training rows cannot tell apart is an error."""
    J, labels, _ = views(rng)
    H = torch.cat(J[:3]).clone()
    H[:, labels == 2] = 0
    chain = dense(J[3], H, 0.0, labels)
    smaller = dense(J[3][:, labels != 2], H[:, labels != 2], 0.0, labels[labels != 2])
    assert chain.left_out == 13
    assert chain.mutual_information == pytest.approx(smaller.mutual_information, rel=1e-9)
    assert chain.block_logdet == pytest.approx(smaller.block_logdet, rel=1e-9)
    H[:, 1] = 2 * H[:, 0]
    with pytest.raises(ValueError, match="dense: H \\+ lambda must be positive definite"):
        dense(J[3], H, 0.0)
    with pytest.raises(ValueError, match="one column a parameter"):
        dense(J[3][:, 1:], H, 0.0)


def test_independent_parameters_are_exact(rng):
    """Where the parameters are independent, the diagonal is no approximation."""
    H, Hc = (torch.diag(torch.tensor(rng.uniform(0.5, 2, 26))) for _ in range(2))
    chain = dense(Hc, H, 0.1, torch.arange(26) // 13)
    assert chain.logdet == pytest.approx(chain.mutual_information, rel=1e-12)
    assert chain.block_logdet == pytest.approx(chain.mutual_information, rel=1e-12)
    assert chain.eig == pytest.approx(chain.trace_bound, rel=1e-12)


def test_one_default_criterion():
    """Everything that chooses views does so by `v_opt` unless asked otherwise, from Python and on the command line;
    what scores one view is told by what.
    """
    import inspect

    from drgs.checks.records import options_in
    from drgs.commands.options import Fit, Select
    from drgs.fitting.config import SelectionConfig
    from drgs.select import Scoring

    for function in (information_gain, scorer):
        assert inspect.signature(function).parameters["criterion"].default is inspect.Parameter.empty
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'criterion'"):
        information_gain({}, {})
    options = (options_in(kind)["criterion"].default for kind in (Fit, Select))
    defaults = {Scoring().criterion, SelectionConfig().scoring.criterion, *options}
    assert defaults == {next(iter(CRITERIA))} == {"v_opt"}


def test_lambda_is_of_the_criterion():
    """1e-2 of `v_opt`, 1e-6 of the others and of other policies; what is given goes before."""
    from drgs.fitting.config import SelectionConfig
    from drgs.select import Scoring

    assert Scoring().prior_of() == Scoring("v_opt").prior_of("fisher") == Prior(1e-2)
    assert all(Scoring(x).prior_of() == Prior(1e-6) == Scoring().prior_of("fisherrf") for x in list(CRITERIA)[1:])
    assert Scoring(prior=Prior(0.5)).prior_of() == Scoring(prior=Prior(0.5)).prior_of("coverage") == Prior(0.5)
    of = lambda **fields: SelectionConfig().replace(**fields).scoring.prior_of()  # noqa: E731
    assert of() == Prior(1e-2)
    assert of(prior=Prior(1e-4)) == Prior(1e-4)
    assert of(relative=True) == Prior(1e-6, relative=True)
