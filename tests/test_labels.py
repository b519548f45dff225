import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import LabelSpace
from semstab.data.labels import moving, shipped_taxonomies
from semstab.errors import ConfigError, DataError
from semstab.testing import checks

UAVID8, UAVID7, UAVID3 = (LabelSpace.load(name) for name in ("uavid8", "uavid7", "uavid3"))
COARSE = LabelSpace("coarse", ("built", "green"), members=(("building", "road"), ("tree",)), ignored=("clutter",))


def u8(*ids):
    return np.array([ids], np.uint8)


def u16(*ids):
    return np.array([ids], np.uint16)


# --- Mapping label maps -----------------------------------------------------------------------------------------------


def test_uavid8_to_uavid7_ignores_clutter():
    mapped = UAVID8.mapping_to(UAVID7).labels(u8(0, 1, 2, 3, 4, 5, 6, 7, 255), "map.png")
    assert mapped.tolist() == [[255, 0, 1, 2, 3, 4, 5, 6, 255]]


def test_uavid7_to_uavid3_merges_and_ignores():
    mapped = UAVID7.mapping_to(UAVID3).labels(u8(0, 1, 2, 3, 4, 5, 6, 255), "map.png")
    assert mapped.tolist() == [[0, 1, 255, 2, 2, 255, 255, 255]]


@checks
@given(st.lists(st.integers(0, 7) | st.just(255), min_size=1))
def test_mapping_in_two_steps_is_mapping_in_one(ids):
    steps = UAVID7.mapping_to(UAVID3).labels(UAVID8.mapping_to(UAVID7).labels(u8(*ids), ""), "")
    assert steps.tolist() == UAVID8.mapping_to(UAVID3).labels(u8(*ids), "").tolist()


@pytest.mark.parametrize("space", [UAVID8, UAVID7, UAVID3])
def test_a_taxonomy_maps_to_itself(space):
    ids = [*range(len(space)), 255]
    assert space.mapping_to(space).labels(u8(*ids), "").tolist() == [ids]


def test_names_compare_without_case_and_punctuation():
    source = LabelSpace("theirs", ("Low-Vegetation", "STATIC_CAR", " road "))
    assert source.mapping_to(UAVID7).rows == (4, 2, 1)


def test_a_class_that_is_mapped_nowhere_is_named():
    source = LabelSpace("theirs", ("road", "water", "tree", "bridge"))
    with pytest.raises(ConfigError, match=r"^taxonomy uavid7: no class takes 'water, bridge' of theirs; add the name"):
        source.mapping_to(UAVID7)


def test_a_mapping_that_ignores_everything_is_refused():
    cars = LabelSpace("cars", ("static car", "moving car"))
    with pytest.raises(ConfigError, match="every class of cars is ignored"):
        cars.mapping_to(UAVID3)


def test_16_bit_maps_keep_both_ignore_ids():
    mapped = UAVID8.mapping_to(UAVID7).labels(u16(1, 255, 65535), "map.png")
    assert (mapped.tolist(), mapped.dtype) == ([[0, 255, 255]], np.uint8)


def test_255_is_a_class_where_the_taxonomy_goes_beyond_it():
    source = LabelSpace("wide", ("road", "tree", "building"), ids=(254, 255, 300))
    assert source.mapping_to(UAVID3).labels(u16(254, 255, 300, 65535), "").tolist() == [[1, 2, 0, 255]]
    assert source.mapping_to(UAVID3).labels(u8(254, 255), "").tolist() == [[1, 255]]


def test_ids_need_not_be_consecutive():
    source = LabelSpace("sparse", ("tree", "road"), ids=(40, 3))
    assert source.mapping_to(UAVID3).labels(u8(3, 40, 255), "").tolist() == [[1, 2, 255]]


def test_many_classes_map_to_16_bits():
    wide = LabelSpace("wide", tuple(f"class {k}" for k in range(300)))
    mapped = wide.mapping_to(wide).labels(u16(0, 255, 299, 65535), "")
    assert (mapped.tolist(), mapped.dtype) == ([[0, 255, 299, 65535]], np.uint16)


def test_255_classes_are_the_most_that_8_bits_hold():
    space = LabelSpace("wide", tuple(f"class {k}" for k in range(255)))
    turned = LabelSpace("turned", space.classes[::-1])
    mapped = turned.mapping_to(space).labels(u16(0, 254, 65535), "")
    assert (mapped.tolist(), mapped.dtype) == ([[254, 0, 255]], np.uint8)


@pytest.mark.parametrize("labels", [u8(0, 9, 8, 9), u16(0, 9, 8, 9)])
def test_an_id_outside_the_taxonomy_is_named_with_its_file(labels):
    expected = (
        r"^labels/0012.png: label id 8, 9 \(3 pixels\) is outside the taxonomy uavid8 \(8 classes, ids 0 to 7\); "
    )
    with pytest.raises(DataError, match=expected):
        UAVID8.mapping_to(UAVID7).labels(labels, "labels/0012.png")


def test_many_ids_outside_are_abbreviated():
    with pytest.raises(DataError, match=r"label id 8, 9, 10, 11, 12, \.\.\. \(10 pixels\)"):
        UAVID8.mapping_to(UAVID7).labels(u8(*range(18)), "map.png")


# --- Mapping scores ---------------------------------------------------------------------------------------------------

FINE = LabelSpace("fine", ("tree", "clutter", "road", "building"))


def test_scores_of_classes_that_fall_together_are_summed():
    scores = np.array([[[0.125, 0.25, 0.5, 0.125]]], np.float32)
    assert FINE.mapping_to(COARSE).scores(scores, "").tolist() == [[[0.625, 0.125]]]


def test_where_the_label_is_ignored_the_scores_are():
    """A class that is left out takes its pixels with it, not only its share of them."""
    source = LabelSpace("fine", ("road", "sky", "tree"))
    target = LabelSpace("coarse", ("road", "tree"), ignored=("sky",))
    mapping = source.mapping_to(target)
    scores = np.random.default_rng(0).dirichlet(np.ones(3), (40, 50)).astype(np.float32)
    mapped = mapping.scores(scores, "")
    labels = mapping.labels(scores.argmax(axis=2).astype(np.uint8), "")
    np.testing.assert_array_equal(mapped.sum(axis=2) > 0, labels != 255)
    np.testing.assert_array_equal(mapped[labels != 255], scores[labels != 255][:, [0, 2]])


def test_half_precision_scores_are_summed_in_single():
    scores = np.full((1, 1, 4), 40000, np.float16)
    mapped = FINE.mapping_to(COARSE).scores(scores, "")
    assert (mapped.dtype, mapped.tolist()) == (np.float32, [[[80000, 40000]]])


def test_scores_are_not_copied_where_nothing_changes():
    scores = np.ones((1, 1, 7), np.float32)
    assert UAVID7.mapping_to(UAVID7).scores(scores, "") is scores


def test_scores_are_reordered_like_labels():
    source = LabelSpace("turned", ("green", "built"))
    assert source.mapping_to(COARSE).scores(np.array([[[0.25, 0.75]]]), "").tolist() == [[[0.75, 0.25]]]


def test_scores_of_another_number_of_classes_are_refused():
    with pytest.raises(DataError, match=r"^s.npz: scores hold 7 classes, uavid8 has 8$"):
        UAVID8.mapping_to(UAVID7).scores(np.ones((1, 1, 7)), "s.npz")


# --- Taxonomies -------------------------------------------------------------------------------------------------------


def test_the_papers_taxonomies_ship():
    assert {"uavid8", "uavid7", "uavid3"} <= set(shipped_taxonomies())
    assert (len(UAVID8), len(UAVID7), len(UAVID3)) == (8, 7, 3)


@pytest.mark.parametrize("name", shipped_taxonomies())
def test_a_taxonomy_is_what_its_file_says(name):
    space = LabelSpace.load(name)
    assert space.name == name
    assert LabelSpace.from_dict(space.to_dict()) == space


def test_ids_and_colours_have_defaults():
    space = LabelSpace("two", ("a", "b"))
    assert space.ids == (0, 1)
    assert len(set(space.colors)) == 2
    assert space.members == ((), ())


def test_an_unknown_taxonomy_gets_the_nearest_known_one():
    with pytest.raises(ConfigError, match=r"taxonomy 'uavid' is not known; did you mean 'uavid\d'\?"):
        LabelSpace.load("uavid")
    with pytest.raises(ConfigError, match=r"known: .*uavid7.*or a \.yaml file"):
        LabelSpace.load("zzz")


def test_a_taxonomy_from_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("classes: [road, {name: tree, id: 9, color: [1, 2, 3], members: [bush]}]\nignored: [sky]\n")
    space = LabelSpace.load(path)
    assert (space.name, space.classes, space.ids, space.colors[1]) == ("mine", ("road", "tree"), (0, 9), (1, 2, 3))
    assert (space.members, space.ignored) == (((), ("bush",)), ("sky",))


BROKEN_FILES = {
    "not YAML": "classes: [road, {name: tree", "not YAML in two lines": "classes:\n  - road\n - tree\n",
    "a date that is none": "name: 2020-13-45", "empty": "", "a list": "[road, tree]", "no classes": "name: mine",
    "classes not a list": "classes: road", "an unknown key": "classes: [a, b]\nclases: [c]",
    "a class without a name": "classes: [{id: 0}, b]",
    "an unknown key of a class": "classes: [{name: a, colour: [0, 0, 0]}, b]",
    "a name that is a number": "classes: [1, b]", "an id that is text": "classes: [{name: a, id: one}, b]",
    "an id that is a truth value": "classes: [{name: a, id: true}, b]",
    "a colour of two": "classes: [{name: a, color: [1, 2]}, b]",
    "a colour beyond 255": "classes: [{name: a, color: [1, 2, 256]}, b]",
    "members not a list": "classes: [{name: a, members: c}, b]", "ignored not names": "classes: [a, b]\nignored: [1]",
    "nothing there": None, "not text": b"\xff\xfe\x00",
}  # fmt: skip


@pytest.mark.parametrize("content", BROKEN_FILES.values(), ids=BROKEN_FILES.keys())
def test_a_taxonomy_file_that_is_none_is_one_line_with_its_name(tmp_path, content):
    path = tmp_path / "mine.yaml"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigError) as error:
        LabelSpace.load(path)
    assert "mine.yaml: " in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"classes": ()}, "0 class"), ({"classes": ("a",)}, "at least 2"), ({"ids": (0,)}, "1 ids for 2 classes"),
        ({"colors": ((0, 0, 0),) * 3}, "3 colors for 2 classes"), ({"members": ((),)}, "1 members for 2 classes"),
        ({"ids": (1, 1)}, "distinct"), ({"ids": (-1, 1)}, "distinct, 0 to 65534"),
        ({"ids": (0, 65535)}, "distinct, 0 to 65534"), ({"ids": (0, 255)}, "255 means 'ignore'"),
        ({"classes": ("Low vegetation", "low_vegetation")}, "'low vegetation' is named twice"),
        ({"members": (("c",), ("c",))}, "'c' is named twice"), ({"ignored": ("a",)}, "'a' is named twice"),
    ],
)  # fmt: skip
def test_a_label_space_that_contradicts_itself_is_refused(fields, message):
    with pytest.raises(ConfigError, match=message) as error:
        LabelSpace(**{"name": "mine", "classes": ("a", "b")} | fields)
    assert str(error.value).startswith("taxonomy mine: ")


def test_classes_that_move_are_known_by_their_last_word() -> None:
    names = (
        "road", "Moving_Car", "static car", "human", "car, auto, automobile", "bus stop", "train track",
        "parked vehicles", "vehicles", "people", "Traffic light", "buses", "carpet", "animals (wild)",
        "bus;coach", "van/truck",
    )  # fmt: skip
    assert [names[k] for k in moving(names)] == [
        "Moving_Car", "human", "car, auto, automobile", "vehicles", "people", "animals (wild)", "bus;coach",
        "van/truck",
    ]  # fmt: skip
