"""Names of RobotCar's images: condition, camera and time."""

from __future__ import annotations

from megloc_kapture.datasets.robotcar import ImageKey, parse_image


def test_names_of_images_are_parsed_with_and_without_a_condition() -> None:
    key = ImageKey("night-rain", "rear", "1418840689734892")
    for name in ("night-rain/rear/1418840689734892.png", "./night-rain/rear/1418840689734892.jpg"):
        assert parse_image(name) == key
    assert (key.timestamp, key.path) == (1418840689734892, "night-rain/rear/1418840689734892")
    assert parse_image("rear/5.png") == ImageKey("", "rear", "5")


def test_other_names_are_rejected() -> None:
    for name in ("5.png", "a/b/rear/5.png", "../rear/5.png", "/rear/5.png", "dawn//5.png"):
        assert parse_image(name) is None, name
    for name in ("5.PNG", "5.jpeg", "x.jpg", "-5.jpg", f"{'1' * 20}.jpg"):
        assert parse_image(f"dawn/rear/{name}") is None, name
