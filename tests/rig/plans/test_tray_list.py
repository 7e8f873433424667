"""The list of a tray, and the decisions of its operator."""

import csv
import io
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.catalog import Catalog
from rig.core.errors import NoObject, ObjectNotFound, RotationDisagreement, UsageError, ViewRejected
from rig.events.events import Accepted, Item
from rig.plans.enroll import enroll
from rig.plans.operator import Choice, Subject
from rig.plans.tray import OBJECT_ERRORS, TrayItem, enroll_tray, read_tray

TEXT = st.text(string.ascii_letters + string.digits + " äöü,;\"'-_", min_size=1, max_size=12).map(str.strip)


def written(tmp_path, text):
    path = tmp_path / "tray.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def mistakes(tmp_path, text):
    with pytest.raises(UsageError) as caught:
        read_tray(written(tmp_path, text))
    assert caught.value.next_step
    return caught.value.evidence["mistakes"]


def test_lists_of_spreadsheets_are_read(tmp_path):
    expected = (TrayItem(2, "mug", "kitchen", "white, chipped"), TrayItem(4, "lamp", "", "", 12))
    comma = 'name,label,note,views\nmug,kitchen,"white, chipped",\n ,,,,,\nlamp,,,12\n'
    assert read_tray(written(tmp_path, comma)) == expected
    semicolon = '\ufeffName;Label;Note;Views\r\nmug;kitchen;"white, chipped";\r\n\r\nlamp;;;12\r\n'
    assert read_tray(written(tmp_path, semicolon)) == expected
    assert read_tray(written(tmp_path, "name\nmug")) == (TrayItem(2, "mug"),)


@given(
    names=st.lists(TEXT.filter(bool), min_size=1, max_size=8, unique=True),
    texts=st.lists(st.tuples(TEXT, TEXT), min_size=8, max_size=8),
    separator=st.sampled_from(",;"),
)
def test_list_of_a_csv_writer_is_read_back(tmp_path_factory, names, texts, separator):
    buffer = io.StringIO()
    writer = csv.writer(buffer, delimiter=separator)
    writer.writerow(["note", "name", "label"])
    rows = [(note, name, label) for name, (note, label) in zip(names, texts, strict=False)]
    writer.writerows(rows)
    items = read_tray(written(tmp_path_factory.mktemp("tray"), buffer.getvalue()))
    assert [(item.note, item.name, item.label) for item in items] == rows


@given(
    st.binary(max_size=200) | st.text(string.printable, max_size=200).map(lambda text: f"name,note\n{text}".encode())
)
def test_random_content_is_read_or_rejected_with_a_message(tmp_path_factory, content):
    rejected = None
    try:
        items = read_tray(written(tmp_path_factory.mktemp("tray"), content))
    except UsageError as error:
        rejected = error
    if rejected is None:
        assert items
        assert len({item.name for item in items}) == len(items)
    else:
        assert rejected.evidence["mistakes"]


def test_every_mistake_is_reported_with_its_line(tmp_path):
    found = mistakes(tmp_path, "name,label,views\nmug,a\n,b\nlamp,c,three\nmug,d\nx,y,4,z\nbo\x07ok,e\n")
    assert [mistake.split(":")[0] for mistake in found] == ["line 3", "line 4", "line 6", "line 7", "line 2", "line 5"]
    assert "'three'" in found[1]
    assert "2 times" in found[4]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "its columns are missing"),
        ("name,label\n", "no objects"),
        ("naem,label\nmug,a\n", "line 1: its columns are naem, label"),
        ("name,size\nmug,a\n", "line 1: its columns are name, size"),
        ("label,note\na,b\n", "must be name"),
        ("name,name\na,b\n", "each at most once"),
        ('name\n"mug\n', "not CSV"),
        ("name\nmug\nname\xe4\n".encode("latin-1"), "line 3: byte 0xe4"),
        ("name,views\nmug,3\n", "from 4 to 720"),
        (f"name,views\nmug,{'1' * 5000}\n", "from 4 to 720"),
    ],
)
def test_unusable_lists_are_rejected(tmp_path, text, words):
    assert words in " ".join(mistakes(tmp_path, text))


class Scripted:
    """An operator with prepared decisions."""

    def __init__(self, bring=(), problem=()):
        self._bring, self._problem = list(bring), list(problem)
        self.brought = []
        self.troubles = []

    def choose(self, question):
        if question.subject is Subject.FAILURE:
            self.troubles.append(question.text)
            return self._problem.pop(0)
        self.brought.append(question.text)
        return self._bring.pop(0) if self._bring else Choice.CONTINUE


@pytest.fixture
def catalog(tmp_path, simulated):
    with Catalog.open(tmp_path / "catalog", clock=simulated().bench.clock) as catalog:
        yield catalog


def items(*names):
    return [TrayItem(line, name) for line, name in enumerate(names, 2)]


def actions(events):
    return [(e.name, e.action) for e in events if isinstance(e, Item)]


def interrupted(s, catalog, name, views=4):
    plan = enroll(s.bench, catalog, name, views=views)
    for event in plan:
        if isinstance(event, Accepted) and event.index == 1:
            break
    plan.close()


def test_interrupted_object_that_was_moved_is_enrolled_again(simulated, catalog):
    s = simulated()
    interrupted(s, catalog, "lamp")
    events = list(enroll_tray(s.bench, catalog, items("lamp"), views=4, operator=Scripted([Choice.RESTART])))
    assert actions(events) == [("lamp", "replace")]
    assert sum(isinstance(e, Accepted) for e in events) == 4
    assert len({view.session for view in catalog.object("lamp").views}) == 1


def test_object_that_fails_is_skipped_or_ends_the_tray(simulated, catalog):
    s = simulated()
    operator = Scripted(problem=[Choice.SKIP])
    events = list(enroll_tray(s.bench, catalog, items("nonsense", "dice"), views=4, operator=operator))
    assert actions(events) == [("nonsense", "enroll"), ("nonsense", "skip"), ("dice", "enroll")]
    with pytest.raises(ObjectNotFound):
        list(enroll_tray(s.bench, catalog, items("nonsense"), views=4))
    assert {NoObject, ViewRejected, RotationDisagreement, ObjectNotFound} == set(OBJECT_ERRORS)


def test_object_in_the_dark_is_tried_again_with_its_stored_views(simulated, catalog):
    s = simulated()

    class Lights(Scripted):
        def choose(self, question):
            if question.subject is Subject.FAILURE:
                s.world.change(light=(1.0, 1.0, 1.0))
            return super().choose(question)

    operator = Lights(problem=[Choice.CONTINUE])
    events = []
    for event in enroll_tray(s.bench, catalog, items("dice"), views=4, operator=operator):
        if isinstance(event, Accepted) and not any(isinstance(earlier, Accepted) for earlier in events):
            s.world.change(light=(0.0, 0.0, 0.0))
        events.append(event)
    (failure,) = operator.troubles
    assert failure.startswith("dice: View 2 was rejected")
    assert actions(events) == [("dice", "enroll"), ("dice", "resume")]
    assert catalog.object("dice").summary.views == 4
