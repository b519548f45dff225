"""From a model's classes to a taxonomy's, by name: strict and lenient."""

import numpy as np
import pytest
import tiny_models

from semstab import LabelSpace
from semstab.errors import ConfigError
from semstab.models import Model, Prediction
from semstab.models.names import InTaxonomy, class_mapping, vocabularies

UAVID = LabelSpace.load("uavid-one-car")
CITYSCAPES = LabelSpace("model", tiny_models.CITYSCAPES)
ADE = LabelSpace(
    "model", ("wall", "building", "sky", "tree", "road", "windowpane", "grass", "sidewalk", "person",
              "door;double door", "plant", "car", "house", "field", "grandstand", "path", "stairs", "hovel", "van",
              "dirt track"),
)  # fmt: skip


def targets(source, target=UAVID, leniency="strict"):
    """The target class of each source class, None where it is ignored."""
    mapping = class_mapping(source, target, leniency)
    rows = zip(source.classes, mapping.rows, strict=True)
    return {name: None if row is None else target.classes[row] for name, row in rows}


def test_cityscapes_in_the_classes_of_uavid():
    found = targets(CITYSCAPES)
    assert found["vegetation"] == "tree"  # where UAVid's vegetation is low
    assert found["terrain"] == "low vegetation"
    assert {found[name] for name in ("car", "truck", "bus")} == {"car"}
    assert {found[name] for name in ("person", "rider")} == {"human"}
    assert found["sidewalk"] == found["sky"] == found["train"] == "clutter"
    assert targets(CITYSCAPES, leniency="lenient") == found | {"sidewalk": "road"}


def test_ade20k_in_the_classes_of_uavid():
    found = targets(ADE)
    assert {name for name, target in found.items() if target == "building"} == {
        "building", "windowpane", "door;double door", "house", "grandstand", "hovel",
    }  # fmt: skip
    assert {name for name, target in found.items() if target == "low vegetation"} == {"grass", "plant", "field"}
    assert found["wall"] == found["stairs"] == found["path"] == "clutter"
    lenient = targets(ADE, leniency="lenient")
    assert {name for name in found if found[name] != lenient[name]} == {"sidewalk", "path", "dirt track"}


def test_a_certain_class_that_the_taxonomy_lacks_is_not_the_rest():
    with pytest.raises(
        ConfigError, match=r"^taxonomy uavid7: no class takes 'car, truck, bus' of model; add the names"
    ):
        class_mapping(CITYSCAPES, LabelSpace.load("uavid7"))
    assert targets(CITYSCAPES, LabelSpace.load("uavid7"), "lenient")["car"] is None


def test_what_a_taxonomy_says_itself_comes_before_the_rest():
    taxonomy = LabelSpace("own", ("green", "walkable"), members=(("tree", "low vegetation"), ("road", "sidewalk")), ignored=("clutter", "building", "car", "human"))  # fmt: skip  # noqa: E501
    assert targets(CITYSCAPES, taxonomy)["sidewalk"] == "walkable"
    assert targets(CITYSCAPES, taxonomy)["vegetation"] == "green"


def test_other_classes_go_by_their_own_names():
    model = LabelSpace("model", ("Building", "low_vegetation", "car, automobile"))
    assert targets(model) == {"Building": "building", "low_vegetation": "low vegetation", "car, automobile": "car"}
    water = LabelSpace("model", ("road", "water"))
    with pytest.raises(
        ConfigError, match=r"no class takes 'water' of model; .*leave them out with the lenient mapping"
    ):
        class_mapping(water, UAVID)
    assert targets(water, leniency="lenient") == {"road": "road", "water": None}


def test_a_mapping_that_leaves_out_most_classes_warns(caplog):
    """Names as some checkpoints have them, of a vocabulary that is not recognised: 145 of 150."""
    names = ("building, edifice", "road, route", "tree", "car, auto, automobile, machine, motorcar", "human")
    model = LabelSpace("model", (*names, *(f"thing {k}" for k in range(145))))
    mapping = class_mapping(model, UAVID, "lenient")
    assert sum(row is not None for row in mapping.rows) == 5
    assert "does not have 145 of the 150 classes of model; they are left out, among them thing 0," in caplog.text
    caplog.clear()
    class_mapping(LabelSpace("model", (*names, "thing 0")), UAVID, "lenient")
    assert not caplog.text


def test_vocabularies_name_classes_of_uavid_once():
    for vocabulary in vocabularies().values():
        uavid = {*UAVID.classes}
        assert {*vocabulary.strict, *vocabulary.lenient, vocabulary.rest} <= uavid
        names = [
            name for table in (vocabulary.strict, vocabulary.lenient) for group in table.values() for name in group
        ]
        assert len(names) == len(set(names))


class FourPixels(Model):
    """A model with known labels and scores."""

    label_space = LabelSpace("model", ("tree", "grass", "road"))
    gives_scores = True
    fit_frames = 2

    def fit(self, images):
        return self

    def predict(self, images, *, scores=False):
        labels = np.array([[0, 1, 2, 255]], dtype=np.uint8)
        soft = np.array([[[0.5, 0.3, 0.2], [0.1, 0.2, 0.7], [0, 0, 1], [1, 0, 0]]], dtype=np.float32)
        return [Prediction(labels, soft if scores else None)] * len(images)

    def identity(self):
        return {"model": "four"}


GREEN = LabelSpace("green", ("road", "green"), ids=(7, 3), members=((), ("tree", "grass")))


def test_predictions_come_in_the_taxonomy_with_rows_as_ids():
    model = InTaxonomy(FourPixels(), GREEN, "strict").fit([])
    (prediction,) = model.predict([None], scores=True)
    assert prediction.labels.tolist() == [[1, 1, 0, 255]]
    np.testing.assert_allclose(prediction.scores[0], [[0.2, 0.8], [0.7, 0.3], [1, 0], [0, 0]], atol=1e-6)
    assert (model.label_space.classes, model.label_space.ids) == (("road", "green"), (0, 1))
    assert model.predict([None])[0].scores is None
    assert model.fit_frames == 2


def test_identity_has_the_mapping():
    identity = InTaxonomy(FourPixels(), GREEN, "strict").identity()
    assert identity["model"] == "four"
    assert identity["rows"] == [1, 1, 0]
    assert identity["taxonomy"]["name"] == "green"


def test_regions_have_no_taxonomy():
    model = FourPixels()
    model.label_space = None
    with pytest.raises(ConfigError, match="regions without classes cannot be brought into a taxonomy"):
        InTaxonomy(model, GREEN, "strict")
