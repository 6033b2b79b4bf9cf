"""The page of `lbmc bench` in a real browser: headless Chromium opens the file and clicks through the viewer."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from tests.end_to_end.bench_scenes import write_pair
from tests.end_to_end.scenes import random_weights
from tests.runner import in_process

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
selenium = pytest.importorskip("selenium.webdriver")
pytestmark = pytest.mark.skipif(BROWSER is None or DRIVER is None, reason="chromium and chromedriver are not installed")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The page of two tiny scenes, opened from its file."""
    folder = tmp_path_factory.mktemp("page")
    for seed, name in enumerate(("first", "second")):
        write_pair(folder, name, seed)
    weights = random_weights(folder / "tiny.safetensors")
    run = in_process("bench", folder, "--out", folder, "--model", weights, "--no-paper", "--no-memory", "--no-savings",
                     "--no-flip", "--repeats", 1, "--frame", 0, "--progress", "none")
    assert run.code == 0, run.err
    options = selenium.ChromeOptions()
    options.binary_location = BROWSER
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                 "--window-size=1200,1000", "--proxy-server=127.0.0.1:9"):  # no way out to any network
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = selenium.Chrome(options=options, service=selenium.ChromeService(executable_path=DRIVER))
    try:
        driver.get((folder / "report.html").as_uri())
        yield driver
    finally:
        driver.quit()


def shown(browser: Any) -> list[str]:
    """What each pane shows."""
    found: list[str] = browser.execute_script(
        "return [...document.querySelectorAll('.pane')].map(p => p.dataset.method)")
    return found


def transforms(browser: Any) -> set[str]:
    """Where the images of all panes stand."""
    return set(browser.execute_script("return [...document.querySelectorAll('.pane img')].map(i => i.style.transform)"))


def click(browser: Any, selector: str) -> None:
    browser.find_element("css selector", selector).click()


def methods(browser: Any) -> list[str]:
    found: list[str] = browser.execute_script(
        "return [...document.querySelectorAll('#methods button')].map(b => b.dataset.method)")
    return found


def test_nothing_goes_wrong_and_nothing_is_fetched(browser: Any) -> None:
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in fetched if not name.startswith("data:")] == []
    assert browser.execute_script("return document.querySelectorAll('figure svg').length") >= 5


def test_every_method_can_be_flipped_to_and_is_an_image(browser: Any) -> None:
    names = methods(browser)
    assert {"reference", "noisy", "à-trous wavelets", "lbmc tiny"} <= set(names)
    sources = set()
    for name in names:
        click(browser, f'#methods button[data-method="{name}"]')
        assert shown(browser) == [name]
        size = browser.execute_async_script(
            "const image = document.querySelector('.pane img'); const done = arguments[0];"
            "image.decode().then(() => done([image.naturalWidth, image.naturalHeight]))")
        assert size == [32, 24]
        sources.add(browser.execute_script("return document.querySelector('.pane img').src"))
        pressed = browser.execute_script("return document.querySelector('#methods [aria-pressed=true]').dataset.method")
        assert pressed == name
    assert len(sources) == len(names)


def test_keys_flip_too(browser: Any) -> None:
    names = methods(browser)
    body = browser.find_element("tag name", "body")
    body.send_keys("2")
    assert shown(browser) == [names[1]]
    body.send_keys("\ue014")  # arrow right
    assert shown(browser) == [names[2]]
    body.send_keys("1")
    body.send_keys("\ue012")  # arrow left, around to the last
    assert shown(browser) == [names[-1]]


def test_zoom_is_kept_between_methods_and_shared_side_by_side(browser: Any) -> None:
    click(browser, "#fit")
    body = browser.find_element("tag name", "body")
    body.send_keys("1")
    before = transforms(browser)
    browser.execute_script(
        "const pane = document.querySelector('.pane'), box = pane.getBoundingClientRect();"
        "pane.dispatchEvent(new WheelEvent('wheel', {deltaY: -400, clientX: box.left + 50, clientY: box.top + 50,"
        " cancelable: true}))")
    zoomed = transforms(browser)
    assert zoomed != before
    assert browser.find_element("id", "zoom").text == "379 %"  # exp(400 / 300)
    body.send_keys("2")
    assert transforms(browser) == zoomed
    click(browser, "#grid")
    assert shown(browser) == methods(browser)
    assert len(transforms(browser)) == 1
    browser.execute_script(
        "document.querySelectorAll('.pane')[1].dispatchEvent(new WheelEvent('wheel', {deltaY: 200, cancelable: true}))")
    assert len(transforms(browser)) == 1
    click(browser, "#grid")
    assert len(shown(browser)) == 1
    click(browser, "#fit")
    assert browser.find_element("id", "zoom").text == "100 %"


def test_pixels_are_squares_unless_the_image_is_made_smaller(browser: Any) -> None:
    rendering = "return getComputedStyle(document.querySelector('.pane img')).imageRendering"
    assert browser.execute_script(rendering) == "pixelated"
    resize = ("document.querySelector('.pane').style.height = '{}'; window.dispatchEvent(new Event('resize'));")
    assert browser.execute_script(resize.format("10px") + rendering) == "auto"  # the image is 24 pixels high
    assert browser.execute_script(resize.format("") + rendering) == "pixelated"


def test_dragging_moves_the_image(browser: Any) -> None:
    from selenium.webdriver import ActionChains

    browser.execute_script(
        "document.querySelector('.pane').dispatchEvent(new WheelEvent('wheel', {deltaY: -600, cancelable: true}))")
    before = transforms(browser)
    pane = browser.find_element("css selector", ".pane")
    ActionChains(browser).click_and_hold(pane).move_by_offset(-40, -30).release().perform()
    assert transforms(browser) != before
    after = transforms(browser)
    ActionChains(browser).move_by_offset(30, 10).perform()  # let go of
    assert transforms(browser) == after


def test_another_scene_keeps_the_method(browser: Any) -> None:
    click(browser, '#methods button[data-method="noisy"]')
    source = browser.execute_script("return document.querySelector('.pane img').src")
    browser.execute_script(
        "const s = document.getElementById('scene'); s.value = 'second'; s.dispatchEvent(new Event('change'))")
    assert shown(browser) == ["noisy"]
    assert browser.execute_script("return document.querySelector('.pane img').src") != source
    assert "second" in browser.execute_script("return document.querySelector('.pane img').alt")
