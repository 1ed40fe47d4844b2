"""Turns an estimate into a `Calibration`: standard deviations, empirical factors, verdicts and warnings.

A kind of sensor has a part in it by functions of its `assess` facet. All are optional; sentences are text for users.

    residuals(inputs, estimate, timeline)           records of residuals, instead of the rows of all its factors
    planes(inputs, state)                           planes of the scene
    keyframe_instants(inputs, state)                stream key and instants of measurements that keyframes may lie at
    notes(inputs, estimate, timeline)               sentences on its data and noise
    ambiguities(inputs, estimate, fits)             notes on other values that fit as well
    warnings(inputs, estimate)                      sentences on its data
    inner_contradictions(inputs, estimate, segments)    sentences on measurements of one sensor that contradict one
                                                    another, each with a change (B,) that standard deviations cover
    value_warnings(groups)                          warnings on estimates that cannot be right
    causes(inputs, estimate, groups, factor, relaxed_rig)   each a `Cause`: its values in the rig file that are wrong
    clock_causes(inputs, estimate)                  each a `Cause`: clocks that the model leaves out
    unreliable(rig, factors)                        kinds of residuals that mean nothing
    many_rejected(fits), overstated_noise(rig, fits)        sentences on outliers, and on noise stated too large
    misfit(sensor, fit, is_noise)                   a sentence on residuals larger than stated, or None
    length(sensor, rig)                             what shows the metric scale, as text, or None
    sizes(sensor)                                   names of parameters that do so if they are stated
    absurd(sensor, groups)                          sentences on impossible estimates
    is_far_guess(sensor, name, groups)              whether the guess of a group is contradicted; None if it has no test
    looks_like(sensor, name, value, estimate)       a likely mistake behind a wrong value, as a sentence with a space
"""

from icalib.validation.assess import assess, visited
from icalib.validation.guesses import stated_words

__all__ = ["assess", "stated_words", "visited"]
