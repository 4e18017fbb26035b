"""How fast a wave travels along a closed road: the pattern of speeds, followed from moment to moment."""

import numpy as np

from unjam.worlds.record import Episode, Floats

CELLS = 512
"""places along the road at which the speed is looked at"""
LATER = 8.0
"""time between the two moments that are compared [s]: a wave moves far less than half a lap in it"""
SMALLEST_WAVE = 0.5
"""standard deviation of speed along the road below which there is no wave to follow [m/s]"""


def wave_speed(episode: Episode) -> float:
    """Return how fast the pattern of speeds travels along a closed road [m/s]; NaN where there is no wave.

    Negative: against the direction of travel, as real stop-and-go waves do. It is the shift at which the
    speeds along the road are most like those `LATER` seconds before, averaged over the second half of the
    episode: the peak of their circular cross-correlation.
    """
    half = len(episode.speeds) // 2
    field = speed_along_road(episode.speeds[half:], episode.positions[half:], episode.loop_length)
    if field.std(1).mean() < SMALLEST_WAVE:
        return float("nan")
    steps = round(LATER / episode.step)
    spectrum = np.fft.rfft(field - field.mean(1, keepdims=True), axis=1)
    correlation = np.fft.irfft((spectrum[:-steps].conj() * spectrum[steps:]).mean(0), n=CELLS)
    shift = (np.argmax(correlation) + CELLS / 2) % CELLS - CELLS / 2
    return float(shift * episode.loop_length / CELLS / LATER)


def speed_along_road(speeds: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return the speed at each of `CELLS` places of a closed road, shape (moments, CELLS) [m/s].

    Between vehicles it is interpolated. Speeds and positions have the shape (moments, vehicles).
    """
    places = np.arange(CELLS) * (loop_length / CELLS)
    moments = zip(speeds, positions, strict=True)
    return np.array(
        [np.interp(places, there % loop_length, speed, period=loop_length) for speed, there in moments]
    )
