"""Studies: experiments as data.

A *study* trains some *learners* on some *tasks*. An *arm* is a learner on a task. Where a study tunes, every arm first
tries settings on the validation split, the same number for every arm; the best of them is then trained with the seeds
that count, which are scored on the test split. The runs are trained as those of a sweep, in a directory like a sweep's.
"""
