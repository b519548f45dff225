"""Models that a user brings as a class or a function; and the border, where every answer is looked at."""

from __future__ import annotations

import json
import re
import sys
import tracemalloc
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import predicted_scene
import pytest
from pictures import blobs
from typer.testing import CliRunner

from semstab import LabelSpace
from semstab.cli import app
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.models import Model, Prediction, create
from semstab.models.validation import Checked
from semstab.predict.predictor import PredictorConfig, load_predictor, parse_predictor

IMAGE = blobs()

MODEL = """
import numpy as np

class Bright:
    classes = ["dark", "bright"]

    def __init__(self, above: float = 128.0, table: str = ""):
        self.above = above

    def predict(self, image):
        return (image.mean(axis=2) > self.above).astype(int)

class Sure(Bright):
    def predict(self, image):
        share = image.mean(axis=2) / 255
        return np.dstack([1 - share, share])

def bright(image, above=128.0):
    return (image.mean(axis=2) > above) - 0

class Counting:
    classes = ("odd", "even")
    sequential = True

    def reset(self):
        self.count = 0

    def __call__(self, image):
        self.count += 1
        return np.full(image.shape[:2], self.count % 2)

NUMBER = 3
"""

WANTED = (IMAGE.mean(axis=2) > 128).astype(np.uint8)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(MODEL)
    return path


def written(tmp_path, text):
    path = tmp_path / "other.py"
    path.write_text(text)
    return path


def labels_of(model):
    (prediction,) = model.predict([IMAGE])
    return prediction.labels


# --- What can be named ------------------------------------------------------------------------------------------------


def test_a_class_in_a_file(file):
    model = create(f"{file}:Bright")
    assert model.label_space.classes == ("dark", "bright")
    np.testing.assert_array_equal(labels_of(model), WANTED)
    assert labels_of(model).dtype == np.uint8
    assert not labels_of(create(f"{file}:Bright", above=255.0)).any()


def test_a_function_in_a_file(file):
    model = create(f"{file}:bright", classes="dark, bright")
    assert model.label_space.classes == ("dark", "bright")
    np.testing.assert_array_equal(labels_of(model), WANTED)
    assert not labels_of(create(f"{file}:bright", classes=["a", "b"], above=255)).any()


def test_a_class_of_a_package(file, monkeypatch):
    monkeypatch.chdir(file.parent)
    np.testing.assert_array_equal(labels_of(create("own:Bright")), WANTED)


def test_files_beside_it_can_be_imported(file, tmp_path):
    other = written(tmp_path, "from own import Bright\nclass Best(Bright): pass\n")
    np.testing.assert_array_equal(labels_of(create(f"{other}:Best")), WANTED)


@pytest.mark.parametrize("lazy", [False, True], ids=["at the top", "while it predicts"])
def test_two_repositories_may_call_their_modules_the_same(tmp_path, lazy):
    """Each network gets what lies beside its own file, also where they take turns."""
    line = "from net.layers import SIGN\nimport helpers_of_a_net as helpers\n"
    body = "return ((SIGN + helpers.SIGN) * (image.mean(axis=2) - 128.0) > 0).astype(int)\n"
    inside = line.replace("\n", "\n        ") if lazy else ""
    for name, sign in (("first", 1), ("second", -1)):
        (tmp_path / name / "net").mkdir(parents=True)
        (tmp_path / name / "net/layers.py").write_text(f"SIGN = {sign}\n")
        (tmp_path / name / "helpers_of_a_net.py").write_text(f"SIGN = {sign}\n")
        text = f"class Net:\n    classes = ['dark', 'bright']\n    def predict(self, image):\n        {inside}{body}"
        (tmp_path / name / "model.py").write_text(("" if lazy else line) + text)
    first, second = (create(f"{tmp_path / name / 'model.py'}:Net") for name in ("first", "second"))
    for _ in range(2):
        np.testing.assert_array_equal(labels_of(first), WANTED)
        np.testing.assert_array_equal(labels_of(second), IMAGE.mean(axis=2) < 128)


def test_what_lies_beside_a_file_comes_before_what_lies_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shapes.py").write_text(
        "SIGN = -1\nclass Net:\n    def predict(self, image):\n        return image[..., 0]\n"
    )
    create("shapes:Net", classes=["a", "b"])
    (tmp_path / "repository/shapes").mkdir(parents=True)
    (tmp_path / "repository/shapes/__init__.py").touch()
    (tmp_path / "repository/shapes/layers.py").write_text("SIGN = 1\n")
    text = (
        "from shapes.layers import SIGN\nclass Net:\n    classes = ['dark', 'bright']\n    def predict(self, image):\n"
    )
    (tmp_path / "repository/model.py").write_text(
        f"{text}        return (SIGN * (image.mean(axis=2) - 128.0) > 0).astype(int)\n"
    )
    np.testing.assert_array_equal(labels_of(create(f"{tmp_path}/repository/model.py:Net")), WANTED)


def test_a_model_of_ones_own(tmp_path):
    text = """
from semstab.models import Model, Prediction
from semstab.config import Settings
from semstab.data.labels import LabelSpace
import numpy as np

class Options(Settings):
    id: int = 0

class One(Model):
    Options = Options
    label_space = LabelSpace("two", ("a", "b"))
    def __init__(self, options):
        self.options = options
    def predict(self, images, *, scores=False):
        return [Prediction(np.full(image.shape[:2], self.options.id, np.uint8)) for image in images]
    def identity(self):
        return {"id": self.options.id}
"""
    one = written(tmp_path, text)
    assert labels_of(create(f"{one}:One", id=1)).all()
    before = create(f"{one}:One", id=1).identity()
    one.write_text(text + "# changed\n")
    assert create(f"{one}:One", id=1).identity() != before
    with pytest.raises(ConfigError, match="unknown setting 'di'; known: id"):
        create(f"{one}:One", di=1)


def test_scores(file):
    (found,) = create(f"{file}:Sure").predict([IMAGE], scores=True)
    np.testing.assert_allclose(found.scores[..., 1], IMAGE.mean(axis=2) / 255, rtol=1e-6)
    np.testing.assert_array_equal(found.labels, found.scores.argmax(axis=2))
    assert labels_of(create(f"{file}:Sure")).dtype == np.uint8
    with pytest.raises(DataError, match=r"own.py:Bright: gives labels, no scores"):
        create(f"{file}:Bright").predict([IMAGE], scores=True)


def test_a_sequential_one(file):
    model = create(f"{file}:Counting")
    assert model.sequential
    for _ in range(2):
        model.reset()
        found = model.predict([IMAGE] * 3)
        assert [int(prediction.labels[0, 0]) for prediction in found] == [1, 0, 1]


def test_less_than_no_class_is_ignored(tmp_path):
    text = "classes = ['a', 'b']\ndef f(image):\n    return image[..., 0].astype(int) * 0 - 1\n"
    assert (labels_of(create(f"{written(tmp_path, text)}:f")) == 255).all()


@pytest.mark.parametrize(
    ("said", "classes"),
    [
        ("classes = {1: 'b', 0: 'a'}", ("a", "b")),
        ("CLASSES = ['a', 'b', 'c']", ("a", "b", "c")),
        ("from semstab import LabelSpace\nlabel_space = LabelSpace('x', ('a', 'b'), ids=(4, 2))", ("a", "b")),
    ],
)
def test_classes_of_the_file(tmp_path, said, classes):
    path = written(tmp_path, f"{said}\ndef f(image): pass\n")
    assert create(f"{path}:f").label_space.classes == classes


def test_classes_of_another_file(file, tmp_path):
    names = tmp_path / "names.txt"
    names.write_text("dark\n\nbright\n")
    assert create(f"{file}:bright", classes=str(names)).label_space.classes == ("dark", "bright")
    taxonomy = tmp_path / "names.yaml"
    taxonomy.write_text("classes: [{name: dark, id: 0}, {name: bright, id: 1, color: [255, 255, 255]}]")
    assert create(f"{file}:bright", classes=str(taxonomy)).label_space.colors[1] == (255, 255, 255)


# --- What its predictions are kept under ------------------------------------------------------------------------------


def test_identity_is_of_the_code_and_of_what_options_name(file, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("1")
    said = f"{file}:Bright"
    usual = create(said, table=str(table)).identity()
    assert create(said, table=str(table)).identity() == usual
    assert create(said, table=str(table), above=3.0).identity() != usual
    assert str(tmp_path) not in json.dumps(usual)
    table.write_text("2")
    assert create(said, table=str(table)).identity() != usual
    table.write_text("1")
    file.write_text(MODEL + "\n")
    assert create(said, table=str(table)).identity() != usual


def test_threads_change_no_key_and_are_those_of_torch_or_of_the_code(file, tmp_path, monkeypatch):
    asked = list[int]()
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(set_num_threads=asked.append))
    assert create(f"{file}:Bright", threads=2).identity() == create(f"{file}:Bright").identity()
    assert asked == [2]
    program = tmp_path / "own.py"
    program.write_text(
        "class Own:\n    classes = ['a', 'b']\n    def __init__(self, threads=1):\n        self.threads = threads\n"
        "    def predict(self, image):\n        return image[..., 0] * 0 + self.threads - 2\n"
    )
    model = create(f"{program}:Own", threads=3)
    assert model.predict([IMAGE])[0].labels.max() == 1
    assert asked == [2]
    assert model.identity() == create(f"{program}:Own").identity()


def test_a_predictor_is_called_as_its_class_and_found_from_anywhere(file, monkeypatch):
    monkeypatch.chdir(file.parent)
    (file.parent / "table.csv").write_text("1")
    found = parse_predictor("own.py:Bright,table=table.csv,above=3")
    assert found.label_name == "Bright"
    resolved = found.resolved()
    assert resolved.model == f"{file}:Bright"
    assert resolved.options == {"classes": None, "threads": None, "table": str(file.parent / "table.csv"), "above": 3}


# --- What it prints, and scores in half precision ---------------------------------------------------------------------


def test_what_it_prints_goes_to_standard_error(tmp_path, capsys):
    text = """
import sys
classes = ["a", "b"]
print("imported")
class F:
    def __init__(self):
        print("loading")
        self.once = sys.stdout
    def predict(self, image):
        print("predicting")
        return image[..., 0] * 0
"""
    model = create(f"{written(tmp_path, text)}:F")
    labels_of(model)
    sys.stdout.write("an answer\n")
    said = capsys.readouterr()
    assert (said.out, said.err) == ("an answer\n", "imported\nloading\npredicting\n")


def test_scores_in_half_precision_are_not_copied(tmp_path):
    text = """
import numpy as np
classes = [f"c{k}" for k in range(50)]
SCORES = np.full((48, 80, 50), 1 / 50, np.float16)
def f(image):
    return SCORES
"""
    model = Checked(create(f"{written(tmp_path, text)}:f"), "f")
    (found,) = model.predict([IMAGE], scores=True)
    assert found.scores.dtype == np.float16
    tracemalloc.start()
    model.predict([IMAGE], scores=True)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < found.scores.nbytes  # a copy in float32 takes twice that, in float64 four times


# --- What cannot be used ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("nowhere.py:Bright", {}, "nowhere.py: there is no such file"),
        ("own.py", {}, "write FILE.py:NAME"),
        ("own.py:", {}, "write FILE.py:NAME"),
        ("a b:Bright", {}, "write FILE.py:NAME"),
        ("own.py:Brihgt", {}, "has no 'Brihgt'; did you mean 'Bright'"),
        ("own.py:NUMBER", {}, "is a int; name a class"),
        ("own.py:Bright", {"abvoe": 3}, "unexpected keyword argument 'abvoe'"),
        ("own.py:bright", {"classes": "a,b", "abvoe": 3}, "unexpected keyword argument 'abvoe'"),
        ("own.py:bright", {}, "its classes are not known; .*--classes a,b,c"),
        ("own.py:bright", {"classes": ","}, "holds no name"),
        ("own.py:np", {}, "is a module; name a class"),
    ],
)
def test_names_and_options_that_cannot_be_used(file, monkeypatch, name, options, message):
    monkeypatch.chdir(file.parent)
    with pytest.raises(ConfigError, match=message) as caught:
        create(name, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("import segmenters_that_nobody_has", MissingDependencyError, "install segmenters_that_nobody_has"),
        ("x = 1\ny = z", DataError, r"NameError at other.py:2: name 'z' is not defined"),
        ("def f(image:\n", DataError, r"SyntaxError at other.py:1: "),
        ("import sys\nsys.exit('usage: model FILE')", DataError, "SystemExit at other.py:2: usage: model FILE"),
        ("class F:\n  def __init__(self):\n    1 / 0\n", DataError, "ZeroDivisionError at other.py:3"),
        ("import torch\ndef g():\n  return torch.load(__file__)\nF = g()", DataError, r"Error at other.py:3: "),
        ("class F:\n  classes = ['a', 'b']\n", ConfigError, "has no method predict"),
        ("class F:\n  def __init__(self, weights): pass\n", ConfigError, "missing a required argument: 'weights'"),
        ("class F:\n  sequential = True\n  classes = ['a', 'b']\n  def predict(self, i): pass\n", ConfigError, "reset"),
    ],
)
def test_code_that_fails_says_where(tmp_path, text, kind, message):
    with pytest.raises(kind, match=message) as caught:
        create(f"{written(tmp_path, text)}:F")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("gives", "message"),
    [
        ("None", r"gave object of shape \(\)"),
        ("image", r"gave uint8 of shape \(48, 80, 3\) for an image of \(48, 80\); give labels"),
        ("image[..., 0] / 255", "gave float64 of shape"),
        ("image[..., 0] * 0 + 7", "gave the label 7, but has 2 classes, 0 to 1"),
        ("image[1:, :, 0] * 0", r"gave uint8 of shape \(47, 80\)"),
        ("1 / 0", "ZeroDivisionError at other.py:3: division by zero"),
    ],
)
def test_answers_that_cannot_be_used(tmp_path, gives, message):
    path = written(tmp_path, f"classes = ['a', 'b']\ndef f(image):\n    return {gives}\n")
    with pytest.raises(DataError, match=message):
        create(f"{path}:f").predict([IMAGE])


def test_from_the_command_line(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = str(predicted_scene.write(tmp_path / "flight", frames=2))
    options = ("--classes", "dark,bright", "--set", "above=100.0")
    done = CliRunner().invoke(app, ["predict", "-m", "own.py:bright", "--data", scene, *options])
    assert done.exit_code == 0, done.output
    said = json.loads((tmp_path / "flight/labels/bright/predictions.json").read_text())
    assert said["settings"]["classes"] == ["dark", "bright"]
    done = CliRunner().invoke(app, ["--predict", "own.py:light", "--data", scene])
    assert (done.exit_code, done.output.count("\n")) == (2, 1)
    assert "own.py: has no 'light'; did you mean 'bright'?" in done.output
    done = CliRunner().invoke(app, ["--classes", "a,b", "--data", scene])
    assert done.output.startswith(
        "error: --classes names the classes of a model that --predict chooses; name the classes of label maps"
    )


# --- The border -------------------------------------------------------------------------------------------------------


class Plugin(Model):
    label_space = LabelSpace("two", ("a", "b"), ids=(3, 9))
    gives_scores = True

    def __init__(self, gives=None, identity=None):
        self.gives, self.about = gives, identity

    def predict(self, images, *, scores=False):
        return self.gives

    def identity(self):
        return self.about


FINE = np.full((48, 80), 9, np.uint8)
SOFT = np.full((48, 80, 2), 0.5, np.float32)


@pytest.mark.parametrize(
    ("gives", "message"),
    [
        (None, "gave nothing for 1 images"),
        ([], "gave 0 predictions for 1 images; give a list with one each"),
        ([Prediction(FINE)] * 2, "gave 2 predictions for 1 images"),
        ([FINE], "gave a ndarray of uint8; give a semstab.models.Prediction"),
        ([Prediction(FINE.astype(int))], "gave labels that are a ndarray of int64"),
        ([Prediction(FINE[1:])], r"gave labels of shape \(47, 80\) for an image of \(48, 80\)"),
        ([Prediction(FINE - 9)], "gave the id 0, which is not an id of its 2 classes"),
        ([Prediction(FINE)], "gave scores that are nothing"),
        ([Prediction(FINE, SOFT[..., :1])], r"gave scores of shape \(48, 80, 1\); give \(48, 80, 2\)"),
        ([Prediction(FINE, SOFT * 2)], "gave scores that are no shares"),
        ([Prediction(FINE, SOFT * np.float32([-1, 3]))], "gave scores that are no shares"),
        ([Prediction(FINE, SOFT * np.nan)], "gave scores that are no shares"),
    ],
)
def test_predictions_are_looked_at_once(gives, message):
    with pytest.raises(DataError, match=rf"^model 'mine' {message}"):
        Checked(Plugin(gives), "mine").predict([IMAGE], scores=True)


def test_what_is_right_passes():
    labels, soft = FINE.copy(), SOFT.copy()
    labels[0], soft[0] = 255, 0
    checked = Checked(Plugin([Prediction(labels, soft)], {"a": [1]}), "mine").fit([])
    (found,) = checked.predict([IMAGE], scores=True)
    assert (found.labels is labels, found.scores is soft) == (True, True)
    assert checked.predict([IMAGE])[0].scores is None
    assert checked.identity() == {"a": [1]}


@pytest.mark.parametrize(
    ("identity", "message"),
    [
        ({"weights": Path("a")}, "not for JSON"),
        ({"weights": float("nan")}, "not for JSON"),
        (None, "gave nothing; give a dict"),
    ],
)
def test_an_identity_is_for_json(identity, message):
    with pytest.raises(ConfigError, match=f"^model 'mine': identity.*{message}"):
        Checked(Plugin(identity=identity), "mine").identity()


def test_a_class_that_is_no_model(monkeypatch):
    half = SimpleNamespace(label_space=None, predict=None, gives_scores=False)
    monkeypatch.setattr("semstab.predict.predictor.create", lambda name, **options: half)
    with pytest.raises(ConfigError, match=r"^model 'x': a SimpleNamespace has no fit_frames, .*stream, identity; der"):
        load_predictor(PredictorConfig(model="x"))


def test_a_label_space_and_a_fit_that_are_none():
    class Wrong(Plugin):
        label_space = ("a", "b")

    with pytest.raises(ConfigError, match=r"label_space is a tuple; make it a semstab.LabelSpace"):
        Checked(Wrong(), "mine")

    class Forgetful(Plugin):
        def fit(self, images):
            pass

    with pytest.raises(ConfigError, match="fit gave nothing; let it return the model"):
        Checked(Forgetful(), "mine").fit([])


# --- The examples of docs/models.md --------------------------------------------------------------------------------

DOCS = Path(__file__).parents[1] / "docs" / "models.md"


def examples() -> dict[str, str]:
    files = [DOCS.parent / name for name in re.findall(r"\]\((examples/\w+\.py)\)", DOCS.read_text())]
    blocks = [*re.findall(r"```python\n(.*?)```", DOCS.read_text(), flags=re.DOTALL), *(f.read_text() for f in files)]
    return {re.search(r"^class (\w+)", block, flags=re.MULTILINE)[1]: block for block in blocks}


@pytest.fixture(scope="module")
def net():
    """Five classes from a linear network, at half the size as real ones do."""
    import torch

    torch.manual_seed(0)
    return torch.nn.Conv2d(3, 5, 3, stride=2, padding=1).eval()


@pytest.fixture
def packages(net, monkeypatch):
    """Stand-ins with the calls of the real packages that the examples use."""
    import torch

    names = ("a", "b", "c", "d", "e")

    def prepared(pixels):
        assert pixels.shape == (3, 48, 80)
        return pixels.float() / 255

    weights = SimpleNamespace(meta={"categories": list(names)}, transforms=lambda: prepared)
    vision = ModuleType("torchvision.models.segmentation")
    vision.DeepLabV3_ResNet50_Weights = SimpleNamespace(DEFAULT=weights)
    vision.deeplabv3_resnet50 = lambda weights: Out(net)
    mmseg = ModuleType("mmseg.apis")
    mmseg.init_model = lambda config, checkpoint, device: SimpleNamespace(dataset_meta={"classes": names})
    mmseg.inference_model = lambda model, image: SimpleNamespace(
        seg_logits=SimpleNamespace(data=full(net, np.ascontiguousarray(image[..., ::-1])))
    )
    ultralytics = ModuleType("ultralytics")

    class YOLO:
        def __init__(self, weights):
            self.names = dict(enumerate("abcd"))

        def __call__(self, image, *, retina_masks, verbose):
            if not image.any():
                return [SimpleNamespace(masks=None)]
            masks = torch.zeros(2, *image.shape[:2])
            masks[0, :20], masks[1, 10:30] = 1, 1
            boxes = SimpleNamespace(conf=torch.tensor([0.9, 0.4]), cls=torch.tensor([2.0, 0.0]))
            return [SimpleNamespace(masks=SimpleNamespace(data=masks), boxes=boxes)]

    ultralytics.YOLO = YOLO
    for module in (vision, mmseg, ultralytics):
        parents = module.__name__.split(".")
        for k in range(1, len(parents)):
            monkeypatch.setitem(sys.modules, ".".join(parents[:k]), ModuleType(parents[0]))
        monkeypatch.setitem(sys.modules, module.__name__, module)


def Out(net):
    import torch

    class Net(torch.nn.Module):
        def forward(self, pixels):
            return {"out": net(pixels)}

    return Net()


def full(net, image):
    """The network's logits at the image's size, (K, H, W)."""
    import torch

    with torch.inference_mode():
        logits = net(torch.from_numpy(image).permute(2, 0, 1)[None] / 255)
        return torch.nn.functional.interpolate(logits, size=image.shape[:2], mode="bilinear")[0]


@pytest.mark.parametrize(
    ("name", "options"),
    [("Mine", {"weights": "net.pt"}), ("DeepLab", {}), ("MMSeg", {"config": "c.py", "checkpoint": "c.pth"})],
)
def test_the_examples_of_the_documentation(tmp_path, monkeypatch, packages, net, name, options):
    import torch

    monkeypatch.chdir(tmp_path)
    torch.save(net, "net.pt")
    text = examples()[name]
    assert len(text.splitlines()) <= 26
    model = Checked(create(f"{written(tmp_path, text)}:{name}", **options), name)
    assert len(model.label_space) == 5
    (found,) = model.predict([IMAGE], scores=True)
    np.testing.assert_allclose(found.scores, full(net, IMAGE).softmax(0).permute(1, 2, 0), atol=1e-6)


def test_the_example_for_instances(tmp_path, packages):
    text = examples()["Yolo"]
    assert len(text.splitlines()) <= 26
    model = Checked(create(f"{written(tmp_path, text)}:Yolo"), "Yolo")
    assert model.label_space.classes == ("a", "b", "c", "d", "background")
    labels = model.predict([IMAGE])[0].labels  # the surer instance lies on top
    assert [int(labels[row, 5]) for row in (5, 15, 25, 40)] == [2, 2, 0, 4]
    assert (model.predict([IMAGE * 0])[0].labels == 4).all()
