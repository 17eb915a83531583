"""The colours of pictures stay apart for those who see fewer of them, and have one home."""

from itertools import combinations

import numpy as np
from rows import each

from graph_slam_ros.colours import DARK, LIGHT

APART = 30.0  # of CIE 1976, where 2.3 is just noticeable
# Machado, Oliveira, Fernandes, "A physiologically-based model for simulation of color vision deficiency", 2009.
SEEN = {
    "all colours": np.eye(3),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]])
WHITE = np.array([0.95047, 1.0, 1.08883])


def linear(colour):
    c = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    ratio = XYZ @ np.clip(rgb, 0.0, 1.0) / WHITE
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@each("seen", SEEN)
@each("colours", [LIGHT, DARK])
def test_every_two_colours_stay_apart(colours, seen):
    found = {name: lab(np.array(SEEN[seen]) @ linear(colour)) for name, colour in colours.items()}
    apart = {(a, b): float(np.linalg.norm(found[a] - found[b])) for a, b in combinations(found, 2)}
    assert min(apart.values()) > APART, min(apart, key=apart.get)
