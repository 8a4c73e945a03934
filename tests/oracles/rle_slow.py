"""COCO's compressed run lengths read character by character into a mask, pixel by pixel."""

import numpy as np


def slow_mask(size: list[int], text: str) -> np.ndarray:
    height, width = size
    numbers: list[int] = []
    digits: list[int] = []
    for character in text:
        code = ord(character) - 48
        digits.append(code % 32)
        if code < 32:  # the last group of a number
            value = sum(digit * 32**place for place, digit in enumerate(digits))
            if digits[-1] >= 16:  # two's complement
                value -= 32 ** len(digits)
            numbers.append(value + numbers[len(numbers) - 2] if len(numbers) > 2 else value)
            digits = []
    mask = np.zeros((height, width), bool)
    place, is_car = 0, False
    for number in numbers:
        for _ in range(number):
            mask[place % height, place // height] = is_car
            place += 1
        is_car = not is_car
    assert place == height * width
    return mask
