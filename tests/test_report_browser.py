"""The page in a real headless Chromium, opened from disk: it loads, moves, turns, listens and stays harmless."""

from __future__ import annotations

import base64
import math
import time

import cv2
import numpy as np
import pytest
import torch

import torchrecon as tr
from eval.browser import CHROMIUM, DRIVER, load, open_browser, resize, severe
from tests.test_report import HOSTILE, film
from torchrecon.data.synthetic import sample_body, sample_motion, turning_camera
from torchrecon.data.synthetic.skeleton import JOINTS, PARENTS
from torchrecon.pipeline.report import write_report

pytest.importorskip("selenium")
if CHROMIUM is None or DRIVER is None:
    pytest.skip("chromium or chromedriver is not installed", allow_module_level=True)

from selenium.webdriver import ActionChains, Keys

FRAMES = 30
# Whether anything at all is drawn, and what: the drawing of this very moment, before it is handed to the screen.
PIXELS = """
torchrecon.draw();
const canvas = document.getElementById(arguments[0]), copy = document.createElement("canvas");
const box = document.getElementById(arguments[1]).getBoundingClientRect(), own = canvas.getBoundingClientRect();
const [x, y, w, h] = [box.left - own.left, box.top - own.top, box.width, box.height].map(Math.round);
[copy.width, copy.height] = [w, h];
copy.getContext("2d").drawImage(canvas, -x, -y);
return copy.toDataURL().split(",")[1];
"""


@pytest.fixture(scope="module")
def driver():
    with open_browser() as driver:
        yield driver


@pytest.fixture(scope="module")
def walker():
    """The joints of a synthetic body, orthographic, with gaps, bones, covariance and hostile names."""
    g = torch.Generator().manual_seed(0)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=FRAMES, generator=g)
    camera = turning_camera(motion, total_turn_deg=90.0, size=(120, 160), projection="orthographic", generator=g)
    joints = camera.to_camera(motion.joints).double()
    scale = float(camera.intrinsics[0, 0] / camera.reference_depth[0])
    xy = camera.project(camera.to_camera(motion.joints)).double()
    visible = torch.ones(FRAMES, len(JOINTS), dtype=torch.bool)
    visible[10:20, 5] = False
    rec = tr.Reconstruction.from_points(
        joints * scale,
        camera.rotations.double(),
        rank=3,
        status=tr.Status("ok", "the truth"),
        translation=xy.mean(1),
        covariance3d=torch.diag(torch.tensor([1.0, 1.0, 9.0])).expand(FRAMES, len(JOINTS), 3, 3),
        observed=visible,
    )
    edges = [(a, b) for b, a in enumerate(PARENTS) if a >= 0]
    spread = (0.25 * torch.eye(2)).expand(*xy.shape, 2)
    return rec, tr.Tracks(xy, visible, spread, names=[HOSTILE + name for name in JOINTS], edges=edges)


@pytest.fixture(scope="module")
def full(walker, tmp_path_factory):
    folder = tmp_path_factory.mktemp("full")
    rank = tr.estimate_rank(walker[1], rule="kritchman_nadler")
    video = film(folder / "frames", FRAMES)
    return write_report(
        walker[0], folder / "r.html", tracks=walker[1], video=video, rank=rank, title=HOSTILE, command=HOSTILE
    )


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """Two opposite points: one right, up and near, which is seen, and one left, down and far, which is not."""
    point = torch.tensor([[30.0, -40.0, -50.0]])
    rec = tr.Reconstruction.from_points(
        torch.cat([point, -point]).expand(3, 2, 3),
        torch.eye(3).expand(3, 3, 3),
        rank=1,
        status=tr.Status("undetermined", "by hand"),
        translation=torch.full((3, 2), 60.0),
        observed=torch.tensor([[True, False]]).expand(3, 2),
    )
    return write_report(rec, tmp_path_factory.mktemp("bare") / "r.html")


@pytest.fixture
def page(driver, full):
    load(driver, full)
    yield driver
    assert severe(driver) == []


def state(driver, name):
    return driver.execute_script("return torchrecon.state[arguments[0]]", name)


def text(driver, name):
    return driver.execute_script("return document.getElementById(arguments[0]).textContent", name)


def pixels(driver, canvas, view):
    png = np.frombuffer(base64.b64decode(driver.execute_script(PIXELS, canvas, view)), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1].astype(float)


def press(driver, *keys):
    ActionChains(driver).send_keys(*keys).perform()


def until(what, seconds=5.0):
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def grey(driver):
    """Grey level of the left quarter of the film, which says which frame is shown; the tracks are switched off."""
    picture = pixels(driver, "film-canvas", "film-view")
    height, width = picture.shape[:2]
    wide = min(width, height * 160 / 120)  # the film stands in the middle of the panel
    left = (width - wide) / 2
    return float(
        picture[height // 2 - 20 : height // 2 + 20, round(left + 0.05 * wide) : round(left + 0.2 * wide)].mean()
    )


def test_arrays_arrive_as_they_were(page, walker):
    rec, tracks = walker
    joints = len(JOINTS)
    found = page.execute_script(
        "const a = torchrecon.arrays; return [a.points, a.xy, a.seen, a.spread].map((x) => Array.from(x))"
    )
    steps = page.execute_script("return [torchrecon.data.steps, torchrecon.data.spread.step]")
    points = np.array(found[0]).reshape(FRAMES, joints, 3) * steps[0]["points"]
    assert np.abs(points - rec.points3d.numpy()).max() < 0.001 * rec.points3d.abs().max()
    seen = np.array(found[2], dtype=bool).reshape(FRAMES, joints)
    assert np.array_equal(seen, tracks.visible.numpy())
    xy = np.array(found[1]).reshape(FRAMES, joints, 2) * steps[0]["xy"]
    assert np.abs(xy - tracks.xy.numpy())[seen].max() < 0.05
    root = np.array(found[3]).reshape(FRAMES, joints, 6) * steps[1]
    np.testing.assert_allclose(root[3, 4], [1, 0, 0, 1, 0, 3], atol=steps[1])


def test_play_and_scrub_move_film_and_shape_together(page):
    for name in ("tool-tracks", "tool-trails"):
        page.find_element("id", name).click()
    first = [pixels(page, "film-canvas", "film-view"), pixels(page, "shape-canvas", "view-free")]
    page.find_element("id", "play").click()
    until(lambda: state(page, "frame") >= 3)
    page.find_element("id", "play").click()
    assert state(page, "playing") is False
    for frame in (state(page, "frame"), 16, 5):
        page.execute_script(
            "const s = document.getElementById('scrub'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))",
            frame,
        )
        assert state(page, "frame") == frame
        # The picture of this very frame: its left side is as grey as the test made it.
        until(lambda frame=frame: abs(grey(page) - 8 * frame) < 4)
    later = [pixels(page, "film-canvas", "film-view"), pixels(page, "shape-canvas", "view-free")]
    for before, after in zip(first, later, strict=True):
        assert (np.abs(before - after).max(-1) > 40).sum() > 50
    assert "6 / 30" in text(page, "clock")


def test_keys_work(page):
    press(page, Keys.END)
    assert state(page, "frame") == FRAMES - 1
    press(page, Keys.HOME, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert state(page, "frame") == 1
    press(page, Keys.SPACE)
    assert state(page, "playing") is True
    press(page, Keys.SPACE)
    assert state(page, "playing") is False
    for key, yaw, pitch in (("1", 0, 0), ("2", math.pi / 2, 0), ("3", 0, math.pi / 2)):
        press(page, key)
        until(lambda yaw=yaw, pitch=pitch: (state(page, "yaw"), state(page, "pitch")) == pytest.approx((yaw, pitch)))
    assert page.find_element("id", "view-top").get_attribute("aria-pressed") == "true"
    before = state(page, "yaw")
    ActionChains(page).key_down(Keys.SHIFT).send_keys(Keys.ARROW_RIGHT).key_up(Keys.SHIFT).perform()
    assert state(page, "yaw") > before
    assert state(page, "preset") is None
    press(page, "m")
    assert state(page, "mirrored") is True
    assert text(page, "said") == "Mirrored answer"
    press(page, "m")
    sure = pixels(page, "shape-canvas", "view-free")
    press(page, "u")
    assert (state(page, "mirrored"), state(page, "spread")) == (False, True)
    assert (np.abs(sure - pixels(page, "shape-canvas", "view-free")).max(-1) > 20).sum() > 100
    # The slider keeps its own keys: one step, not two.
    page.find_element("id", "scrub").send_keys(Keys.HOME, Keys.ARROW_RIGHT)
    assert state(page, "frame") == 1


def test_a_drag_turns_and_a_click_chooses(page):
    free = page.find_element("id", "view-free")
    yaw = state(page, "yaw")
    ActionChains(page).click_and_hold(free).move_by_offset(60, 0).release().perform()
    assert state(page, "yaw") == pytest.approx(yaw - 0.48, abs=0.05)
    assert state(page, "chosen") == -1
    ActionChains(page).move_to_element_with_offset(
        page.find_element("css selector", ".raster"), 0, -30
    ).click().perform()
    chosen = state(page, "chosen")
    assert chosen >= 0
    assert text(page, "chosen").startswith(HOSTILE + JOINTS[chosen])
    press(page, Keys.ESCAPE)
    assert state(page, "chosen") == -1


def test_hostile_names_are_shown_as_text_and_never_run(page):
    assert page.execute_script("return window.hacked === undefined")
    assert text(page, "title") == HOSTILE
    assert text(page, "command") == HOSTILE
    assert HOSTILE + "pelvis" in text(page, "bones")
    # The policy holds even if markup were let in: an inline handler is refused, and the refusal is in the console.
    page.execute_script(
        "const b = document.createElement('button'); b.setAttribute('onclick', 'window.hacked = 1');"
        "document.body.append(b); b.click(); b.remove()"
    )
    assert page.execute_script("return window.hacked === undefined")
    assert any("Content Security Policy" in message for message in severe(page))


def coloured(driver, view):
    """Centre of the saturated pixels in a view, each axis from -1 to 1, up positive, and their mean colour."""
    picture = pixels(driver, "shape-canvas", view)
    strong = picture.max(-1) - picture.min(-1) > 90
    assert strong.sum() > 4
    y, x = (axis.mean() for axis in np.nonzero(strong))
    height, width = strong.shape
    return 2 * x / width - 1, 1 - 2 * y / height, picture[strong].mean(0)


def test_front_side_and_top_show_what_they_say_and_the_mirror_swaps_near_and_far(driver, bare):
    load(driver, bare)
    across = {}
    for view, right, up in (("view-front", 1, 1), ("view-side", -1, 1), ("view-top", 1, -1)):
        x, y, colour = coloured(driver, view)
        assert right * x > 0.1
        assert up * y > 0.1
        assert colour[0] > colour[2] + 60  # near is orange
        across[view] = x, y
    press(driver, "m")
    x, y, colour = coloured(driver, "view-side")
    assert (x, y) == pytest.approx((-across["view-side"][0], across["view-side"][1]), abs=0.03)
    assert colour[2] > colour[0] + 60  # far is blue
    assert coloured(driver, "view-front")[:2] == pytest.approx(across["view-front"], abs=0.03)
    assert coloured(driver, "view-top")[1] == pytest.approx(-across["view-top"][1], abs=0.03)
    assert severe(driver) == []


def test_a_page_without_film_tracks_bones_and_covariance_says_so(driver, bare):
    load(driver, bare)
    press(driver, Keys.END)
    assert state(driver, "frame") == 2
    for name in ("tool-spread", "tool-model", "tool-trails"):
        button = driver.find_element("id", name)
        assert not button.is_enabled()
        assert button.get_attribute("title")
    assert not driver.find_element("id", "bones-part").is_displayed()
    assert "Video" in text(driver, "absent")
    assert text(driver, "film-title") == "Seen from the camera"
    assert text(driver, "headline").startswith("The views do not determine")
    press(driver, "u")
    assert state(driver, "spread") is False
    assert text(driver, "said") == "This solver gives no uncertainty."
    assert severe(driver) == []


def test_without_webgl_the_film_and_the_charts_still_work(driver, full):
    command = "HTMLCanvasElement.prototype.getContext = ((old) => function (kind, ...more) {"
    command += (
        "return kind === 'webgl2' ? null : old.call(this, kind, ...more); })(HTMLCanvasElement.prototype.getContext)"
    )
    added = driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": command})
    try:
        load(driver, full)
        assert "needs WebGL" in driver.find_element("id", "plea").text
        before = pixels(driver, "film-canvas", "film-view")
        press(driver, Keys.END)
        assert state(driver, "frame") == FRAMES - 1
        assert (np.abs(before - pixels(driver, "film-canvas", "film-view")).max(-1) > 40).sum() > 50
        assert severe(driver) == []
    finally:
        driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


def test_nothing_is_wider_than_a_phone_and_every_control_has_a_name(driver, full, bare):
    resize(driver, 390, 844, phone=True, dark=True)
    try:
        for page in (full, bare):
            load(driver, page)
            assert driver.execute_script("return document.documentElement.scrollWidth") <= 390
            nameless = driver.execute_script(
                "return [...document.querySelectorAll('button, input, select, [tabindex]')].filter((e) =>"
                "!e.closest('[hidden]') && !(e.getAttribute('aria-label') || e.textContent.trim())).map((e) => e.id)"
            )
            assert nameless == []
            background = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
            assert sum(int(v) for v in background[4:-1].split(",")) < 120  # dark, as the system asks for
        assert severe(driver) == []
    finally:
        resize(driver, 1400, 900)
