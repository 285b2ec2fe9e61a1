"""Features and a decoder that are fitted to a teacher's maps beside the colors, and the run folder that keeps them."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch
from test_train import FAST, SIZE, config, dataset, masked, scene  # noqa: F401 (a fixture)

import drgs
from drgs import cli
from drgs.commands import render as render_command
from drgs.commands.eval import run as run_eval
from drgs.commands.options import Eval
from drgs.commands.scene_input import SceneInput
from drgs.data.images import read_image
from drgs.data.semantics import Semantics
from drgs.display.pictures import write_png
from drgs.features.pictures import label_colors
from drgs.features.segmentation import Classes, classify
from drgs.files import Run
from drgs.fitting import metrics
from drgs.fitting import trainer as trainer_module
from drgs.fitting.active import ActiveViews
from drgs.fitting.components import semantics
from drgs.fitting.components.base import Setup
from drgs.fitting.components.semantics import SemanticRecord
from drgs.fitting.components.table import components_of
from drgs.fitting.config import SelectionConfig
from drgs.fitting.frames import load_frames
from drgs.fitting.records import load_run
from drgs.fitting.rows import GaussianRows
from drgs.fitting.segments import segmentation_of
from drgs.fitting.semantic_errors import feature_record, label_record, wrong_label
from drgs.fitting.trainer import Trainer
from drgs.selection import policies
from drgs.tracing.weights import Weights
from drgs.train import fit

WIDTH, CHANNELS, CLASSES, MAP = 4, 6, 3, 16
SHORT = {"feature_width": WIDTH, "feature_rate": 0.1, "decoder_rate": 0.03}  # rates of thousands of steps would crawl
GEOMETRY = ("means", "quats", "log_scales", "logit_opacities", "sh_dc")


def embeddings():
    """(K, C) unit rows, far from each other."""
    return torch.eye(CLASSES, CHANNELS)


@pytest.fixture(scope="module")
def taught(dataset, tmp_path_factory):  # noqa: F811
    """The data set with the maps of a perfect teacher, 16x16, and labels: the classes of its Gaussians go by height."""
    folder = tmp_path_factory.mktemp("taught")
    (folder / "rgb_feature_langseg").mkdir()
    g = scene()
    of_gaussians = torch.bucketize(g.means[:, 1].contiguous(), torch.tensor([-0.15, 0.15]))
    g = g.replace(features=embeddings()[of_gaussians])
    views = []
    for view in dataset.views:
        shown = drgs.render(g, view.camera, FAST).features
        labels = torch.where(shown.sum(2) > 0.5, shown.argmax(2) + 1, 0)
        write_png(folder / "semantic_class" / f"{view.name}.png", (labels / 255)[..., None].repeat(1, 1, 3).numpy())
        planes = shown.permute(2, 0, 1)
        small = torch.nn.functional.interpolate(planes[None], (MAP, MAP), mode="bilinear", align_corners=True)[0]
        path = folder / "rgb_feature_langseg" / f"{view.name}_fmap_CxHxW.pt"
        torch.save(small.half(), path)
        label = folder / "semantic_class" / f"{view.name}.png"
        views.append(dataclasses.replace(view, teacher_path=path, label_path=label))
    np.save(folder / "text_embeddings.npy", embeddings().numpy())
    (folder / "classes.txt").write_text("ground\nmiddle\nsky\n")
    known = Semantics(
        teacher="rgb_feature_langseg",
        labels="semantic_class",
        maps=tuple(view.teacher_path for view in views),
        label_images=tuple(view.label_path for view in views),
        class_file=folder / "classes.txt",
        embedding_file=folder / "text_embeddings.npy",
    )
    for view in views:
        view.semantics = known
    return dataclasses.replace(dataset, views=views, semantics=known)


def semantic_trainer(data, **fields):
    """A fit of features at its first step."""
    cfg = config(**{**SHORT, "max_steps": 40, **fields})
    frames = load_frames(data.split()[0], cfg.data.max_pixels, cfg.data.mask)
    points, colors = torch.from_numpy(data.points), torch.from_numpy(data.colors)
    rows, train = GaussianRows.from_points(points, colors), data.split()[0]
    components = components_of()
    setup = Setup(data, cfg, train, [], train, (), components, frames=frames)
    semantics = next(x for x in components if x.name == "semantics")
    semantics.prepare(setup)
    return Trainer(cfg, frames, rows, 3.0, components, setup)


def decoder_of(trainer):
    return trainer.network("decoder")


def test_the_distance_goes_a_few_cells_at_a_time(monkeypatch, rng):
    """Loss and gradients are those of one large product, with fewer cells left over at the end; float32 sums."""
    monkeypatch.setattr(semantics, "_CHUNK", 5 * CHANNELS)
    f, W, b = (
        torch.tensor(rng.normal(size=x), dtype=torch.float32) for x in ((13, WIDTH), (CHANNELS, WIDTH), CHANNELS)
    )
    cells = torch.tensor(rng.normal(size=(CHANNELS, 13)), dtype=torch.float16)
    leaves = [x.requires_grad_() for x in (f, W, b)]
    whole = 3 * (f @ W.T + b - cells.T.float()).abs().mean()
    parts = 3 * semantics._Distance.apply(*leaves, cells)
    torch.testing.assert_close(parts, whole, rtol=1e-6, atol=0)
    for found, want in zip(torch.autograd.grad(parts, leaves), torch.autograd.grad(whole, leaves), strict=True):
        torch.testing.assert_close(found, want, rtol=1e-5, atol=1e-7)


def test_all_learn_from_features_of_zero(taught):
    """With all features 0 the first step moves features and the decoder's bias, and the second its weights, too."""
    trainer = semantic_trainer(taught)
    decoder = decoder_of(trainer)
    weight, bias = decoder.matrix.detach().clone(), decoder.conv.bias.detach().clone()
    assert not trainer.rows.tensors["features"].any()
    trainer.step()
    assert trainer.rows.tensors["features"].any()
    assert not torch.equal(decoder.conv.bias, bias)
    assert torch.equal(decoder.matrix, weight)
    trainer.step()
    assert not torch.equal(decoder.matrix, weight)


@pytest.mark.parametrize("size", ["image", "teacher"])
def test_features_tell_the_teachers_classes(taught, size):
    """40 steps with the true geometry halve the term, and three quarters of the pixels of a view that has not been
    fitted have their class (0.83 when this was written); the most frequent class would be right in half of them.
    """
    trainer, true = semantic_trainer(taught, feature_resolution=size), scene().parameters()
    rows = {**true, "sh_dc": true["sh"], "sh_rest": torch.zeros(40, 0, 3), "features": torch.zeros(40, WIDTH)}
    del rows["sh"]
    trainer.rows = GaussianRows(rows)
    terms = [trainer.step().terms["features"] for _ in range(40)]
    assert np.mean(terms[-8:]) < 0.5 * np.mean(terms[:2])
    (frame, *_) = load_frames(taught.split()[1], 10**6)
    labels = torch.from_numpy(frame.labels())
    shown = drgs.render(trainer.gaussians(), frame.camera, FAST).features
    found = classify(shown, Classes(("a", "b", "c"), embeddings()), decoder_of(trainer))
    assert float((found == labels)[labels > 0].float().mean()) > 0.75


def test_features_learn_from_all_renderers_in_turn(taught, rendered):
    """Each draws features and colors together, and the loss of the features falls under all of them."""
    trainer = semantic_trainer(taught, renderers=("any",), max_steps=40)
    losses = [trainer.step().terms["features"] for _ in range(40)]
    assert {preset for preset, _ in rendered} == {"exact", "fast", "gsplat", "3dgut"}
    assert np.mean(losses[-8:]) < 0.8 * np.mean(losses[:8])


@pytest.mark.parametrize("size", ["image", "teacher"])
@pytest.mark.same_bits
def test_features_leave_the_geometry_alone(taught, size, monkeypatch):
    """Uncoupled, the gradients of everything but features are those of a fit of colors, to the bit; coupled, not.

    What the features say about the weights of compositing is computed where it is coupled only.
    """
    grads, computed, gradient = [], [], Weights.gradient

    def noted(weights, buffer, cotangent, out, features):
        if features is not None:
            computed.append(len(grads))
        return gradient(weights, buffer, cotangent, out, features)

    monkeypatch.setattr(Weights, "gradient", noted)
    for fields in ({}, {"couple_features": True}):
        trainer = semantic_trainer(taught, feature_resolution=size, **fields)
        # Features of 0 have no gradient with respect to where they are.
        trainer.rows.tensors["features"].data.normal_(generator=torch.Generator().manual_seed(1))
        trainer.step()
        grads.append({name: trainer.rows.tensors[name].grad for name in GEOMETRY})
    assert set(computed) == {1}, "by the second trainer"
    plain = semantic_trainer(taught)
    plain.components = components_of()
    plain.rows = GaussianRows({k: x for k, x in plain.rows.tensors.items() if k != "features"})
    plain.step()
    for name in GEOMETRY:
        assert torch.equal(grads[0][name], plain.rows.tensors[name].grad), name
    for name in ("means", "log_scales", "logit_opacities"):
        assert not torch.equal(grads[1][name], grads[0][name]), name


def test_views_without_a_map_show_no_features(taught, monkeypatch):
    """Where a photograph has no map there is no term, no map is read, and features are not rendered."""
    views = [
        dataclasses.replace(view, teacher_path=None if i % 2 else view.teacher_path)
        for i, view in enumerate(taught.views)
    ]
    trainer = semantic_trainer(dataclasses.replace(taught, views=views))
    seen = []

    def spy(gaussians, camera, *rest, **options):
        seen.append((camera.name, gaussians.features is not None))
        return render(gaussians, camera, *rest, **options)

    render = trainer_module.render
    monkeypatch.setattr(trainer_module, "render", spy)
    with_map = {view.name for view in views if view.teacher_path}
    for _ in range(8):
        step = trainer.step()
        assert ("features" in step.terms) == (step.view in with_map)
    assert seen
    assert all(shown == (name in with_map) for name, shown in seen)
    assert {shown for _, shown in seen} == {True, False}


def test_outside_a_mask_a_teacher_has_no_say(taught):
    """What the map says where the mask keeps nothing does not change the term; where it keeps all, it does."""
    trainer = semantic_trainer(taught)
    term, frame = trainer.component("semantics").terms[0], trainer.frames[0]
    trainer.rows.tensors["features"].data.normal_(generator=torch.Generator().manual_seed(1))
    g = trainer.gaussians()
    shown = drgs.render(g, frame.camera, FAST)
    values = frame.teacher().float()
    left = torch.zeros(SIZE, SIZE)
    left[:, : SIZE // 2] = 1

    def at(column, mask):
        other = values.clone()
        other[:, :, column] += 5
        return float(term(shown, dataclasses.replace(frame, mask=mask, teacher=lambda: other), g).detach())

    plain = float(term(shown, dataclasses.replace(frame, mask=left), g).detach())
    assert at(MAP - 1, left) == plain
    assert at(0, left) > plain
    assert term(shown, dataclasses.replace(frame, mask=0 * left), g) is None


@pytest.mark.same_bits
def test_without_a_teacher_no_feature_code_runs(dataset, taught, tmp_path, monkeypatch):  # noqa: F811
    """A data set without maps, and one whose maps are to be ignored, are fitted without importing anything of
    features, to the same bits, and leave the same files.
    """
    for name in (
        "features",
        "features.decoder",
        "features.segmentation",
        "features.teacher",
    ):
        monkeypatch.setitem(sys.modules, f"drgs.{name}", None)  # importing it raises ImportError
    fields = {"max_steps": 6, "save_every": 3, "deterministic": True}
    plain = fit(dataset, tmp_path / "plain", config(**fields), progress=False)
    ignored = fit(taught, tmp_path / "ignored", config(**fields, semantics="ignore"), progress=False)
    for name, x in plain.gaussians.parameters().items():
        assert torch.equal(x, ignored.gaussians.parameters()[name]), name
    assert "features" not in plain.gaussians.parameters()
    files = [{p.relative_to(r).as_posix() for p in r.rglob("*")} for r in (plain.run.path, ignored.run.path)]
    assert files[0] == files[1]
    loaded = load_run(ignored.run)
    assert (loaded.decoder, loaded.classes, loaded.record.semantics) == (None, None, None)


FIT = {**SHORT, "max_steps": 6, "save_every": 3, "deterministic": True, "refine_start": 0.2, "refine_every": 0.3}


@pytest.fixture(scope="module")
def run(taught, tmp_path_factory):
    """A finished run with features."""
    return fit(taught, tmp_path_factory.mktemp("runs") / "run", config(**FIT), progress=False)


def test_a_run_keeps_its_decoder_and_classes(run, taught):
    """config.json names teacher, classes and widths; the decoder and the classes' embeddings come back as they were."""
    loaded = load_run(run.run)
    record = run.run.config()["semantics"]
    assert record == {
        "teacher": "rgb_feature_langseg",
        "labels": "semantic_class",
        "channels": CHANNELS,
        "width": WIDTH,
        "map_size": [MAP, MAP],
        "classes": ["ground", "middle", "sky"],
        "embeddings": True,
    }
    assert loaded.gaussians.features.shape == (len(loaded.gaussians), WIDTH)
    assert loaded.record.semantics.to_json() == record
    assert (loaded.decoder.width, loaded.decoder.channels) == (WIDTH, CHANNELS)
    assert torch.equal(loaded.decoder.matrix, loaded.networks["decoder"]["conv.weight"][:, :, 0, 0])
    assert loaded.classes.names == taught.semantics.classes.names
    assert torch.equal(loaded.classes.embeddings, embeddings())
    assert all(event["features"] > 0 for event in run.run.events() if event["event"] == "train")


@pytest.mark.same_bits
def test_a_resumed_fit_has_the_same_bits(run, taught, tmp_path, monkeypatch):
    """Interrupted halfway and resumed: features, decoder and all moments are those of a whole fit."""
    step, count = Trainer.step, 0

    def three(self):
        nonlocal count
        if count == 3:
            raise KeyboardInterrupt
        count += 1
        return step(self)

    monkeypatch.setattr(Trainer, "step", three)
    with pytest.raises(KeyboardInterrupt):
        fit(taught, tmp_path / "run", config(**FIT), progress=False)
    monkeypatch.undo()
    torch.manual_seed(99)  # where torch's own generator stands does not matter
    again = fit(taught, tmp_path / "run", config(**FIT), resume=True, progress=False)
    one, other = (drgs.files.load_state(r.run.state)[0] for r in (run, again))
    assert {name for name in one if name.startswith("decoder.adam.conv.weight")}
    assert one.keys() == other.keys()
    assert all(torch.equal(x, other[name]) for name, x in one.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"feature_width": 5}, "feature_width was 4 and is 5"),
        ({"semantics": "ignore"}, "semantics was 'auto' and is 'ignore'"),
        ({"teacher": "sam_embeddings"}, "teacher of its semantics was 'rgb_feature_langseg' and is 'sam_embeddings'"),
        ({"class_file": None}, "classes of its semantics was"),
    ],
)
def test_another_teacher_is_not_resumed(run, taught, change, message):
    """A fit goes on with the teacher, classes and width that it began with, or says in one line what differs."""
    known = {key: x for key, x in change.items() if key in ("teacher", "class_file")}
    data = dataclasses.replace(taught, semantics=dataclasses.replace(taught.semantics, **known))
    fields = {key: x for key, x in change.items() if key not in known}
    with pytest.raises(ValueError, match=message) as error:
        fit(data, run.run.path, config(**{**FIT, **fields}), resume=True, progress=False)
    assert "\n" not in str(error.value)


def test_a_damaged_record_is_refused(run, tmp_path):
    """Embeddings of other classes, missing ones, and a decoder that does not go with config.json: one line each."""
    import shutil

    def copied(change):
        folder = tmp_path / "copy"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(run.run.path, folder)
        change(folder)
        with pytest.raises((ValueError, FileNotFoundError)) as error:
            load_run(Run(folder))
        assert "\n" not in str(error.value)
        return str(error.value)

    def edited(**fields):
        def change(folder):
            path = folder / "config.json"
            value = json.loads(path.read_text())
            value["semantics"] |= fields
            path.write_text(json.dumps(value))

        return change

    assert "found none" in copied(lambda folder: (folder / "text_embeddings.npy").unlink())
    wrong = np.zeros((CLASSES, CHANNELS + 1), np.float32)
    assert "a row for each class" in copied(lambda folder: np.save(folder / "text_embeddings.npy", wrong))
    assert "finite and not 0" in copied(lambda folder: np.save(folder / "text_embeddings.npy", wrong[:, 1:]))
    assert "must be >= 1" in copied(edited(width=0))
    assert "classes" in copied(edited(classes=3))

    def alone(folder):
        edited(channels=7, embeddings=False)(folder)
        (folder / "point_cloud.ply").unlink()

    assert "the decoder must take 4 features to 7 channels" in copied(alone)


def test_an_active_fit_reads_no_map_that_was_not_picked(taught, tmp_path, monkeypatch):
    """Of views that were not chosen neither map nor labels are opened, and those that were have a feature term."""
    opened = set()
    real = torch.load

    def load(path, *rest, **options):
        opened.add(path.name.split("_")[0])
        return real(path, *rest, **options)

    monkeypatch.setattr(torch, "load", load)
    data = dataclasses.replace(taught, semantics=dataclasses.replace(taught.semantics))  # nothing cached
    active = SelectionConfig().replace(policy="random", add=2, every=2)
    done = fit(data, tmp_path / "run", config(**FIT, test_every=0, selection=active), progress=False)
    plan = ActiveViews(data.split(0)[0], config(**FIT, selection=active))
    assert len(plan.views) == 9
    assert opened == set(done.metrics["fitted"])
    assert load_run(done.run).decoder is not None


def test_maps_of_held_out_views_alone_teach_nothing(taught):
    """Where no view that is fitted has a map, no features are fitted: none would ever move."""
    held_out = {view.name for view in taught.split(3)[1]}
    views = [view if view.name in held_out else dataclasses.replace(view, teacher_path=None) for view in taught.views]
    data = dataclasses.replace(taught, views=views)
    assert SemanticRecord.of(data, config(test_every=3), data.split(3)[0]) is None
    assert SemanticRecord.of(taught, config(test_every=3), data.split(3)[0]).channels == CHANNELS


def test_without_embeddings_no_label_is_read(tmp_path):
    """Classes that no file names would be the numbers of all label images, those of views that were not picked too."""
    known = Semantics(labels="labels", label_images=(tmp_path / "not_picked.png",))
    record = SemanticRecord("rgb_feature_langseg", "labels", CHANNELS, WIDTH, (MAP, MAP), None, False)
    record.write_embeddings(tmp_path, known)
    assert not list(tmp_path.iterdir())


def test_views_are_chosen_in_the_metric_of_the_decoder_as_it_is(taught, tmp_path, monkeypatch):
    """At every pick features count in the metric of the decoder at that step; selection.json says what was coupled."""
    metrics_of, choose = [], policies.choose

    def watched(policy, pool):
        metrics_of.append(pool.scoring.semantics.matrix)
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", watched)
    active = SelectionConfig().replace(policy="fisher", add=2, every=2, info_pixels=100)
    done = fit(taught, tmp_path / "run", config(**FIT, selection=active), progress=False)
    assert len(metrics_of) == 2
    last = load_run(done.run).decoder.metric()
    assert all(x.shape == last.shape for x in metrics_of)
    assert not torch.equal(metrics_of[0], metrics_of[1])
    report = json.loads((tmp_path / "run/selection.json").read_text())
    for pick in report["picks"]:
        assert pick["blocks"] == ["geometry", "semantic", "backdrop"]
        told = pick["semantics"]
        assert (told["estimate"], told["gamma"], told["width"]) == ("principal", 1.0, WIDTH)
        assert "features" in pick["parts"]


def test_views_are_chosen_for_a_class(taught, tmp_path, monkeypatch):
    """By the features and the decoder at every pick; a class that there is not is refused before the first step."""
    regions, choose = [], policies.choose

    def watched(policy, pool):
        if pool.region is not None:
            regions.append((pool.region.text, pool.region.members(pool.scene)))
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", watched)
    active = SelectionConfig().replace(policy="fisher", add=2, every=8, info_pixels=100, region="class:Sky")
    many = {**FIT, "max_steps": 24, "feature_rate": 0.05}
    done = fit(taught, tmp_path / "run", config(**many, selection=active), progress=False)
    assert [text for text, _ in regions] == ["class:Sky"] * 2
    run = load_run(done.run)
    sky = drgs.Region.of_class("sky", run.classes, run.decoder).members(run.scene)
    assert 0 < float(sky.mean()) < 1
    assert float((regions[-1][1] == sky[: len(regions[-1][1])]).float().mean()) > 0.6  # of an earlier step
    with pytest.raises(ValueError, match="must be one of ground, middle, sky"):
        fit(taught, tmp_path / "no", config(**many, selection=active.replace(region="class:sofa")), progress=False)
    with pytest.raises(ValueError, match="must be of a scene with classes"):
        fit(taught, tmp_path / "no", config(**many, selection=active, semantics="ignore"), progress=False)
    assert not (tmp_path / "no/state.safetensors").exists()


def test_blocks_that_the_fit_does_not_have(taught, tmp_path, monkeypatch):
    """Semantic information of a fit without features is refused before the first step, not at the first pick."""
    monkeypatch.setattr("drgs.train.Trainer", lambda *arguments: pytest.fail("it began"))
    active = SelectionConfig().replace(policy="fisher", add=2, every=2, blocks=("geometry", "semantic"))
    with pytest.raises(ValueError, match="active: blocks must be of what is fitted, got semantic for a fit without"):
        fit(taught, tmp_path / "run", config(semantics="ignore", **FIT, selection=active), progress=False)


def test_labels_are_measured_against_the_data_set(run, taught, monkeypatch, capsys):
    """metrics.json names the reference and has the run's figures beside the teacher's own; `drgs eval` repeats them,
    prints them, and puts labels, reference, features and an overlay beside the picture of the colors.
    """
    found = run.metrics["segmentation"]
    assert (found["reference"], found["folder"]) == ("labels", "semantic_class")
    assert found["classes"] == ["ground", "middle", "sky"]
    assert (found["run"]["images"], len(found["run"]["iou"])) == (2, CLASSES)
    assert found["teacher"]["pixel_accuracy"] > 0.9  # a perfect teacher, but for edges that 16x16 cells blur
    assert found["run"]["pixel_accuracy"] < found["teacher"]["pixel_accuracy"]  # after 6 steps
    assert all(0 <= view["pixel_accuracy"] <= 1 for view in run.metrics["views"])
    # All numbers are in one place, too: means of the images' metrics, and scores of the labels.
    assert SceneInput.at(run.run.path).step == run.metrics["step"] > 0
    labels = {name: found["run"][name] for name in ("pixel_accuracy", "class_accuracy", "miou", "miou_top7")}
    assert run.metrics["scores"] == {**run.metrics["mean"], **labels}
    monkeypatch.setattr("drgs.data.load", lambda path, **_: taught)
    capsys.readouterr()
    run_eval(Eval(run=run.run.path))
    again = json.loads((run.run.path / "metrics.json").read_text())["segmentation"]
    assert again["run"]["pixel_accuracy"] == pytest.approx(found["run"]["pixel_accuracy"], abs=1e-2)
    said = capsys.readouterr().out
    assert "Segmentation of 2 test views, reference: the data set's labels (semantic_class)" in said
    assert f"{again['teacher']['miou']:.4f}" in said
    height, width, _ = read_image(run.run.renders / "test" / "8.semantics.png").shape
    assert height >= SIZE
    assert width > 4 * SIZE


@pytest.mark.parametrize("kind", ["labels", "map"])
def test_references_are_looked_at_before_the_first_step(taught, tmp_path, monkeypatch, kind):
    """A held-out view with labels of no class, or NaN in its map, is refused when hours of fitting are yet to come."""
    test = taught.split(config(**FIT).data.test_every)[1][0]
    if kind == "labels":
        write_png(tmp_path / "bad.png", np.full((SIZE, SIZE, 3), 77 / 255))
        bad, message = {"label_path": tmp_path / "bad.png"}, "bad.png: must hold classes .* got 77"
    else:
        torch.save(torch.full((CHANNELS, MAP, MAP), torch.nan), tmp_path / "bad.pt")
        bad, message = {"teacher_path": tmp_path / "bad.pt"}, "bad.pt: must be finite"
    views = [dataclasses.replace(view, **bad) if view is test else view for view in taught.views]
    monkeypatch.setattr(Trainer, "step", lambda self: pytest.fail("a step was made"))
    with pytest.raises(ValueError, match=message):
        fit(dataclasses.replace(taught, views=views), tmp_path / "run", config(**FIT), progress=False)


def test_without_labels_the_teacher_is_the_reference(taught):
    """Then the output says `teacher`, and has no second row of its own figures, which would be 1."""
    trainer = semantic_trainer(taught)
    g, decoder = trainer.gaussians(), decoder_of(trainer)
    classes, known = Classes(("a", "b", "c"), embeddings()), SemanticRecord.of(taught, trainer.config, taught.views)
    frames = [dataclasses.replace(frame, labels=None) for frame in load_frames(taught.split()[1], 10**6)]
    segmentation = segmentation_of(g, decoder, classes, known.labels, known.teacher, frames)
    result = metrics.evaluate(g, frames, FAST, segmentation=segmentation)["segmentation"]
    assert (result["reference"], result["folder"]) == ("teacher", "rgb_feature_langseg")
    assert (result["teacher"], result["run"]["images"]) == (None, 2)
    names = Classes(("a", "b", "c"))
    told = metrics.evaluate(
        g, frames, FAST, segmentation=segmentation_of(g, decoder, names, known.labels, known.teacher, frames)
    )
    assert told["segmentation"] is None
    assert "text_embeddings.npy" in told["reasons"]["segmentation"]
    assert "has no decoder" in segmentation_of(g, None, classes, known.labels, known.teacher, frames)
    assert "segmentation" not in metrics.evaluate(g.replace(features=None), frames, FAST)


def test_a_reference_is_nothing_outside_a_mask(taught):
    """Pixels that a mask leaves out count for no label."""
    trainer = semantic_trainer(taught)
    (frame, *_) = load_frames(taught.split()[1], 10**6)
    left = torch.zeros(SIZE, SIZE)
    left[:, : SIZE // 2] = 1
    g, known = trainer.gaussians(), SemanticRecord.of(taught, trainer.config, taught.views)
    frames = [dataclasses.replace(frame, mask=left)]
    classes = Classes(("a", "b", "c"), embeddings())
    segmentation = segmentation_of(g, decoder_of(trainer), classes, known.labels, known.teacher, frames)
    result = metrics.evaluate(g, frames, FAST, segmentation=segmentation)["segmentation"]
    assert result["run"]["pixels"] == int((frame.labels()[:, : SIZE // 2] > 0).sum())


def test_other_classes_are_not_measured(run, taught, monkeypatch):
    """A data set whose numbers mean other classes than when the run was fitted is refused in one line."""
    (run.run.path.parent / "other.txt").write_text("a\nb\nc\n")
    other = dataclasses.replace(taught.semantics, class_file=run.run.path.parent / "other.txt")
    monkeypatch.setattr("drgs.data.load", lambda path, **_: dataclasses.replace(taught, semantics=other))
    with pytest.raises(ValueError, match="must have the classes that the run was fitted with"):
        run_eval(Eval(run=run.run.path))


def test_render_writes_what_is_asked_for(run, taught, tmp_path, monkeypatch):
    """--features, --labels and --overlay write a picture a view and a video beside the colors, whose pixels are those
    without them; labels have the colors of their classes, and without these options no feature is rendered.
    """
    monkeypatch.setattr("drgs.commands.viewpoints.data.load", lambda path, **_: taught)
    seen = []

    def spy(gaussians, *rest, **options):
        seen.append(gaussians.features is not None)
        return render(gaussians, *rest, **options)

    render = render_command.render
    monkeypatch.setattr(render_command, "render", spy)
    folder = tmp_path / "all"
    common = f"render {run.run.path} --frames 2 --width {SIZE} --height {SIZE} --preset fast --quiet"
    assert (
        cli.main([*common.split(), "-o", str(folder), "--features", "--labels", "--overlay", "--format", "png,webm"])
        == 0
    )
    assert cli.main([*common.split(), "-o", str(tmp_path / "plain")]) == 0
    assert seen == [True, True, False, False]
    names = sorted(path.name for path in (tmp_path / "plain").glob("*.png"))
    assert len(names) == 2
    for name in names:
        assert read_image(folder / name).tobytes() == read_image(tmp_path / "plain" / name).tobytes()
        for kind in ("features", "labels", "overlay"):
            assert read_image(folder / name.replace(".png", f".{kind}.png")).shape == (SIZE, SIZE, 3)
        drawn = read_image(folder / name.replace(".png", ".labels.png"))
        assert {*map(tuple, drawn.reshape(-1, 3))} <= {*map(tuple, label_colors(CLASSES))}
        is_empty = (drawn == label_colors(CLASSES)[0]).all(-1)
        assert 0.1 < is_empty.mean() < 0.9
        assert is_empty[read_image(folder / name).max(-1) == 0].all()  # nothing but background
    videos = {path.name for path in folder.glob("*.webm")}
    assert videos == {f"turntable{kind}.webm" for kind in ("", ".features", ".labels", ".overlay")}


def test_render_says_what_a_scene_lacks(run, tmp_path, capsys):
    """A scene without features has none to be drawn, and a PLY has no classes: one line, exit code 2, no file."""
    drgs.save_ply(scene(), tmp_path / "plain.ply")
    drgs.save_ply(load_run(run.run).gaussians, tmp_path / "features.ply")
    for name, option, text in (
        ("plain", "--labels", "have Gaussians with semantic features"),
        ("features", "--overlay", "text embeddings of classes"),
    ):
        out = tmp_path / f"out_{name}"
        assert cli.main(["render", str(tmp_path / f"{name}.ply"), "-o", str(out), option]) == 2
        said = capsys.readouterr().err
        assert text in said
        assert len(said.strip().splitlines()) == 1
        assert not list(out.glob("*.png"))


def test_a_run_is_asked_for_its_classes(run, taught, tmp_path, monkeypatch):
    """`drgs query` uses the run's own decoder and classes: each Gaussian belongs to the one class of its label, and
    what --remove writes are all others; masks have the size of the photographs.
    """
    monkeypatch.setattr("drgs.commands.viewpoints.data.load", lambda path, **_: taught)
    loaded = load_run(run.run)
    g = loaded.gaussians
    labels = classify(g.features, loaded.classes, loaded.decoder)
    assert len(labels.unique()) > 1
    for k in labels.unique().tolist():
        name, out = loaded.classes.names[k - 1], tmp_path / str(k)
        for more, ply, wanted in (([], "selected", labels == k), (["--remove"], "rest", labels != k)):
            options = ["--class", name, "-o", str(out), "--limit", "1", "--quiet", *more]
            assert cli.main(["query", str(run.run.path), *options]) == 0
            assert torch.equal(drgs.load_ply(out / f"{ply}.ply").means, g.take(wanted).means)
        masks = list(out.glob("*.mask.png"))
        assert len(masks) == 1
        assert read_image(masks[0]).shape == (SIZE, SIZE, 3)


def test_errors_of_labels_and_features(run, taught):
    """Records of training views: as much is wrong on average as labels and decoded features are, and a map is of a view
    without any. Where the data set has no labels, the teacher's count, and without either there is nothing to say.
    """
    loaded, frames = load_run(run.run), load_frames(taught.split()[0], 10**6)
    right = metrics.evaluate(
        loaded.gaussians,
        frames,
        loaded.record.config.settings,
        segmentation=segmentation_of(loaded.gaussians, loaded.decoder, loaded.classes, "labels", "maps", frames),
    )["segmentation"]
    record = label_record(loaded, frames)
    assert record.mean_misfit == pytest.approx(1 - right["run"]["pixel_accuracy"], abs=1e-3)
    told = wrong_label(loaded.scene, frames[0].camera, record)
    assert told.shape == (SIZE, SIZE)
    assert 0 < float(told.mean()) < 1
    unlabelled = [dataclasses.replace(frame, labels=None) for frame in frames]
    by_teacher = label_record(loaded, unlabelled).mean_misfit
    assert by_teacher == pytest.approx(record.mean_misfit, abs=0.15)  # a perfect teacher, but for edges
    of_features, squares = feature_record(loaded, frames), []
    for frame in frames:
        with torch.no_grad():
            shown = loaded.decoder(drgs.render(loaded.scene, frame.camera, loaded.record.config.settings).features)
        taught_map = frame.teacher().float()[None]
        wanted = torch.nn.functional.interpolate(taught_map, (SIZE, SIZE), mode="bilinear")[0].permute(1, 2, 0)
        squares.append(float((shown - wanted).square().mean()))
    assert of_features.mean_misfit == pytest.approx(np.mean(squares), rel=1e-3)
    with pytest.raises(ValueError, match="label_record: no view has labels or a map"):
        label_record(loaded, [dataclasses.replace(frame, teacher=None) for frame in unlabelled])
    with pytest.raises(ValueError, match="feature_record: must have a run with a decoder"):
        feature_record(dataclasses.replace(loaded, decoder=None), frames)
