"""The whole way in a real browser: clicks, answers, files, and what a kill leaves."""

import re
import signal
from pathlib import Path

import numpy as np
import pytest
from browser import Page, serve_in_process, serve_in_thread
from scipy.stats import chi2
from sessions import open_session

from smartview_jax.io import load_object_model
from smartview_jax.modeling import open_edges

VIEWS = (0, 1, 2, 3, 4)


def separate_views(scene, vertex, wanted=3):
    """Views in which a vertex is not drawn over another one, so that a click means it alone."""
    gaps = np.linalg.norm(scene.pixels - scene.pixels[:, vertex, None], axis=2)
    gaps[:, vertex] = np.inf
    return np.argsort(-gaps.min(axis=1))[:wanted].tolist()


def click_vertex(page, scene, vertex, rng):
    for view in separate_views(scene, vertex):
        page.click(view, scene.click(view, vertex, rng), free=True)
    page.key("n")


def click_face(page, scene, face):
    """Click a face's corners, each in a view where it is apart from the others."""
    for vertex in face.loop:
        (view,) = separate_views(scene, vertex, 1)
        page.click(view, scene.pixels[view, vertex])
    page.key("Enter")


def add_points(session, scene, vertices):
    """The ids of points that are there before the page is opened."""
    ids = []
    for vertex in vertices:
        point = None
        for view in separate_views(scene, vertex):
            point = session.click(session.names[view], scene.click(view, vertex), point)
        ids.append(point)
    return ids


def test_a_model_is_finished_by_clicks_and_a_killed_browser_loses_nothing(
    session, scene, chromium, tmp_path
):
    """Eight points and three faces are there before; the others are clicked."""
    faces, count = scene.truth.faces, len(scene.truth.vertices)
    rng, address = np.random.default_rng(0), serve_in_thread(session)
    ids = add_points(session, scene, range(8))
    for face in (faces[0], faces[2], faces[3]):
        session.add_face([ids[vertex] for vertex in face.loop])
    with Page(chromium, address) as page:
        for vertex in (8, 9):
            click_vertex(page, scene, vertex, rng)
        assert page.counts()[0] == count
        page.key("f")
        click_face(page, scene, faces[4])
        assert page.counts()[2] == 4, page.said()
        before = session.document
        page.crash_browser()

    with Page(chromium, address) as page:
        assert session.document is before
        assert page.counts()[:3] == [count, len(before.edges), 4]
        page.key("f")
        for face in (faces[1], faces[5], faces[6]):
            click_face(page, scene, face)
        page.page.fill(".sv-name", "house")
        page.page.press(".sv-name", "Enter")
        page.key("Control+s")
        assert "saved to" in page.said()
        assert "all saved in house.json" in page.page.inner_text(".sv-kept")
        assert page.faults == []

    model = load_object_model(tmp_path / "house.json")
    assert model.name == "house"
    assert not open_edges(model.faces)
    assert len(model.edges) == len(scene.truth.edges)
    order = [
        int(np.argmin(np.linalg.norm(model.vertices - vertex, axis=1)))
        for vertex in scene.truth.vertices
    ]
    assert sorted(order) == list(range(count))
    # Clicks of 0.3 px and half a pixel of the screen, at 0.2 m: within a millimetre.
    assert np.abs(model.vertices[order] - scene.truth.vertices).max() < 1e-3


def test_a_killed_server_loses_nothing(scene, chromium, tmp_path):
    path, folder = tmp_path / "house.json", Path(__file__).parent
    process, address = serve_in_process(path, folder)
    port = int(re.search(r":(\d+)/", address)[1])
    with Page(chromium, address) as page:
        for vertex in (0, 3):
            for view in separate_views(scene, vertex, 2):
                page.click(view, scene.pixels[view, vertex], free=True)
            page.key("n")
        shown = page.page.evaluate("[...smartviewEditor.model.points]")
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        page.page.wait_for_selector(".sv-kept.lost")
        # A click now is answered by an error, not by silence.
        page.page.evaluate("smartviewEditor.change({do: 'rename', name: 'x'})")
        assert "not there" in page.said()

    with (
        open_session(scene, path) as session,
        Page(chromium, serve_in_thread(session, port)) as again,
    ):
        assert again.page.evaluate("[...smartviewEditor.model.points]") == shown
        assert len(shown) == 2


def test_hovering_draws_curves_and_depth(session, scene, chromium):
    with Page(chromium, serve_in_thread(session)) as page:
        page.page.mouse.move(*page.place(0, scene.pixels[0, 3]))
        page.page.wait_for_function("smartviewEditor.curves !== null")
        curves = page.page.evaluate("smartviewEditor.curves.curves")
        assert set(curves) == {"v2", "v3", "v4", "v5"}
        page.click(0, scene.pixels[0, 3], free=True)
        page.page.mouse.move(*page.place(1, scene.pixels[1, 3]))
        page.page.wait_for_function("smartviewEditor.views[1].hint.textContent.includes('depth')")
        depth = float(re.search(r"depth ([\d.]+) mm", page.page.inner_text(".sv-views"))[1])
        truth = np.linalg.norm(scene.truth.vertices[3] - session.geometry.centres[0])
        # A pixel of the screen is 1.6 of the picture, and some 0.8 mm of depth.
        assert depth == pytest.approx(1e3 * truth, abs=4.0)
        page.click(1, scene.pixels[1, 3], free=True)
        assert "Point 0" in page.page.inner_text(".detail")
        assert "±" in page.page.inner_text(".detail")


def test_undo_help_errors_and_grasp(session, scene, chromium):
    add_points(session, scene, range(10))
    with Page(chromium, serve_in_thread(session)) as page:
        clicks = session.document
        page.key("Control+z")
        assert session.document != clicks
        page.key("Control+y")
        assert session.document == clicks
        page.key("?")
        assert page.page.is_visible(".sv-help")
        page.key("Escape")
        assert not page.page.is_visible(".sv-help")
        page.key("f")
        roof = scene.truth.faces[4]
        click_face(page, scene, roof)
        assert page.counts()[2] == 1, page.said()
        # A face whose corners are not in one plane is refused, in words.
        for vertex in (0, 1, 2, 8):
            (view,) = separate_views(scene, vertex, 1)
            page.click(view, scene.pixels[view, vertex])
        page.key("Enter")
        assert "not planar" in page.said()
        page.key("Escape")
        page.key("g")
        view = 0
        x, y = page.place(view, scene.pixels[view, list(roof.loop)].mean(axis=0))
        page.page.mouse.move(x, y)
        page.page.mouse.down()
        page.page.wait_for_function("smartviewEditor.model.grasps.size === 1")
        angle = next(iter(session.document.grasps.values())).angle
        for step in (1, 3, 5):
            page.page.mouse.move(x + 8 * step, y + 5 * step)
        page.page.mouse.up()
        page.settle()
        page.page.wait_for_function("smartviewEditor.model.grasps.size === 1")
        page.settle()
        (grasp,) = session.document.grasps.values()
        assert grasp.angle != angle
        assert page.faults == []


def drag(page, view, start, end):
    page.page.mouse.move(*page.place(view, start))
    page.page.mouse.down()
    page.page.mouse.move(*page.place(view, (np.array(start) + end) / 2))
    page.page.mouse.move(*page.place(view, end))
    page.page.mouse.up()
    page.settle()


def test_a_rectangle_is_drawn_and_proposals_keep_to_it(session, scene, chromium):
    with Page(chromium, serve_in_thread(session)) as page:
        check_rectangle(page, scene)


def check_rectangle(page, scene):
    page.key("r")
    low, high = scene.pixels[0].min(axis=0) - 12.0, scene.pixels[0].max(axis=0) + 12.0
    # From the lower right to the upper left, which is as good.
    drag(page, 0, high, low)
    drag(page, 1, [20.0, 20.0], [90.0, 60.0])
    shown = page.page.evaluate("Object.fromEntries(smartviewEditor.rectangles)")
    np.testing.assert_allclose(shown["v1"], [*low, *high], atol=2.0)
    assert "all 2 rectangles" in page.said()
    # A click without a drag takes the second one away again; no point was clicked.
    page.page.mouse.click(*page.place(1, [50.0, 40.0]))
    page.settle()
    assert page.page.evaluate("[...smartviewEditor.rectangles.keys()]") == ["v1"]
    assert page.counts() == [0, 0, 0, 0]
    page.page.click('text="Propose in region"')
    page.page.wait_for_function("smartviewEditor.offer.points.length > 0", timeout=60_000)
    seen = [p["in"][0] for p in page.page.evaluate("smartviewEditor.offer.points") if p["in"][0]]
    assert (np.array(seen) > low - 4.0).all()
    assert (np.array(seen) < high + 4.0).all()
    assert page.faults == []


def test_the_symmetry_is_shown_and_confirmed(session, scene, chromium, tmp_path):
    ids = add_points(session, scene, range(10))
    for face in scene.truth.faces:
        session.add_face([ids[vertex] for vertex in face.loop])
    with Page(chromium, serve_in_thread(session)) as page:
        page.page.wait_for_selector(".symmetry:not([hidden])")
        shown = page.page.inner_text(".symmetry")
        assert "2 poses look alike" in shown
        assert "2-fold about (0, 0, 1)" in shown
        assert "Is it meant?" in shown
        page.page.click('.symmetry >> text="Confirm"')
        page.page.wait_for_selector(".symmetry >> text=confirmed: saved with the model")
        page.key("Control+s")
        assert load_object_model(tmp_path / "house.json").symmetry.order == 2
        page.page.click('.symmetry >> text="Refuse"')
        page.page.wait_for_selector(".symmetry >> text=all poses can be told apart")
        page.key("Control+s")
        assert load_object_model(tmp_path / "house.json").symmetry.order == 1
        # An object that no turn maps onto itself has nothing to be asked about.
        session.add_edge(ids[scene.truth.faces[3].loop[0]], ids[scene.truth.faces[3].loop[2]])
        page.page.reload()
        page.wait_until_complete()
        page.page.wait_for_function("smartviewEditor.symmetry?.order === 1")
        assert not page.page.is_visible(".symmetry")
        assert page.faults == []


def test_a_second_page_shows_what_the_first_does(session, scene, chromium):
    """What one page does, another one shows."""
    address = serve_in_thread(session)
    with Page(chromium, address) as one, Page(chromium, address) as two:
        one.click(0, scene.pixels[0, 3], free=True)
        two.page.wait_for_function("smartviewEditor.model.points.size === 1")


def test_the_page_shows_what_disagrees_what_is_likely_and_which_names_are_wrong(
    session, scene, chromium
):
    ids = add_points(session, scene, range(10))
    faces = [session.add_face([ids[v] for v in scene.truth.faces[k].loop]) for k in (2, 3)]
    session.change({"do": "change_face", "id": faces[0], "name": "floor"})
    with Page(chromium, serve_in_thread(session), (1400, 900)) as page:
        check_layout(page)
        check_zoom(page, scene, ids)
        check_snapping(page, ids)
        check_disagreement(page, scene, session, ids)
        check_suggestion(page, session)
        check_names(page, session)
        page.page.set_viewport_size({"width": 390, "height": 844})
        page.page.wait_for_function("document.documentElement.scrollWidth <= 390")
        assert page.faults == []


def check_layout(page):
    """The pictures have no empty margins, and the cells cover the screen."""
    cells = page.page.evaluate(
        """[...document.querySelectorAll(".sv-view")].map((one) => {
            const box = one.getBoundingClientRect(); return [box.width, box.height]; })"""
    )
    aspects = np.array([width / height for width, height in cells[:5]])
    np.testing.assert_allclose(aspects, 640 / 480, rtol=0.01)
    screen = page.page.locator(".sv-views").bounding_box()
    covered = sum(width * height for width, height in cells)
    assert covered > 0.98 * screen["width"] * screen["height"]


def check_zoom(page, scene, ids):
    """The object fills the picture, with a margin, and the whole picture comes back."""
    scales = "smartviewEditor.views.map((view) => view.scale)"
    whole = np.array(page.page.evaluate(scales))
    page.key("z")
    assert (page.page.evaluate(scales) > 1.1 * whole).all()
    for view in VIEWS:
        box = page.page.locator(f'[data-view="v{view + 1}"]').bounding_box()
        places = np.array([page.place(view, pixel) for pixel in scene.pixels[view]])
        places = (places - [box["x"], box["y"]]) / [box["width"], box["height"]]
        assert places.min() > 0.13
        assert places.max() < 0.87
        assert np.ptp(places, axis=0).max() > 0.6
    page.key("0")
    np.testing.assert_allclose(page.page.evaluate(scales), whole)


def check_snapping(page, ids):
    """A click reaches as far as the cursor, on the screen, and the corner are uncertain."""
    reach = """([scale, corner]) => {
        const view = smartviewEditor.views[0], { model } = smartviewEditor;
        model.corners.set("v1", [[10, 10, corner ** 2, 0, corner ** 2]]);
        view.scale = scale;
        const snaps = (d) => model.cornerMeant(0, [10 + d, 10], view.cursorSigma) !== null;
        let [near, far] = [0, 1000];
        while (far - near > 1e-6) {
            const middle = (near + far) / 2;
            if (snaps(middle)) near = middle; else far = middle;
        }
        view.frame();
        return near;
    }"""
    for scale, corner in ((0.5, 0.1), (20.0, 0.1), (20.0, 2.0)):
        actual = page.page.evaluate(reach, [scale, corner])
        # One right click in a hundred is farther; a mouse is right to 1.5 px of the screen.
        expected = np.sqrt(chi2.ppf(0.99, 2)) * np.hypot(1.5 / scale, corner)
        assert actual == pytest.approx(expected, rel=1e-3)
    # A click on the place where the active point is only predicted is measured, not predicted.
    predicted = """(id) => {
        const view = smartviewEditor.views.find(({ name }) =>
            !smartviewEditor.model.points.get(id).clicks[name]);
        smartviewEditor.active = id;
        view.owner.model.corners.clear();
        const at = view.toScreen(smartviewEditor.model.pixel(id, view.index));
        const found = view.target([at[0] + 1, at[1]], false);
        smartviewEditor.active = null;
        return [found.point, found.snapped, view.target([at[0] + 1, at[1]], false).point];
    }"""
    assert page.page.evaluate(predicted, ids[3]) == [None, False, ids[3]]
    page.page.evaluate("smartviewEditor.loadFeatures(smartviewEditor.views[0])")


def check_disagreement(page, scene, session, ids):
    """A wrong click turns its point red, and its view and residuals are named."""
    for view in VIEWS:
        session.click(session.names[view], scene.click(view, 8), ids[8])
    u, v = scene.click(3, 8)
    page.page.evaluate(
        "(change) => { smartviewEditor.change(change); }",
        {"do": "click", "point": ids[8], "view": "v4", "pixel": [u + 6.0, v - 5.0]},
    )
    page.page.wait_for_selector(".doubts:not([hidden])")
    shown = page.page.inner_text(".doubts .box")
    assert f"point {ids[8]} the click in v4 is most probably wrong" in shown
    assert re.search(r"residuals, px: v1 \d\.\d · v2", shown)
    row = page.page.wait_for_selector(f'.sv-row.doubt[data-row="points:{ids[8]}"]')
    assert re.search(r"v1 \d\.\d · v2 .*px", row.inner_text())
    # The ring around the click.
    x, y = page.place(3, [u + 6.0, v - 5.0])
    red = page.page.evaluate(
        """([x, y]) => {
            const view = smartviewEditor.views[3], box = view.element.getBoundingClientRect();
            const context = view.layers[1].getContext("2d");
            const [r, g] = context.getImageData(x - box.left + 11, y - box.top, 1, 1).data;
            return r > 200 && g < 140; }""",
        [x, y],
    )
    assert red
    page.key("Control+z")
    page.page.wait_for_selector(".doubts", state="hidden")


def check_suggestion(page, session):
    """A likely fact is stated by a click, and taken back by undo."""
    page.page.wait_for_selector(".suggested:not([hidden])")
    first = session.suggestions()[0]
    assert not session.document.constraints
    page.page.click('[data-likely="0"]')
    page.settle()
    (fact,) = session.document.constraints.values()
    assert (fact.kind, fact.items) == (first.kind, first.items)
    page.key("Control+z")
    assert not session.document.constraints


def check_names(page, session):
    """A name that the file does not take is said at its field, and not sent."""
    before = session.document
    for field, wrong, said in (
        (".sv-name", "../block", "lead out of its folder"),
        (".detail .sv-text", "floor", "the name 'floor' belongs to faces"),
    ):
        if field != ".sv-name":
            page.page.click('.sv-row[data-row^="faces:"] >> nth=1')
        page.page.fill(field, wrong)
        page.page.wait_for_selector(f'{field}.bad + .sv-problem:has-text("{said}")')
        page.page.press(field, "Enter")
        page.settle()
        assert session.document is before
        # Not even asked for: Python would have refused it in the foot.
        assert "bad" not in page.page.get_attribute(".said", "class")
        page.page.fill(field, "wall")
        page.page.wait_for_selector(f"{field}:not(.bad)")
        page.page.press(field, "Enter")
        page.settle()
        before = session.document
    assert before.name == "wall"
    assert [face.name for face in before.faces.values()] == ["floor", "wall"]
