"""The files from which the page drives: worlds, policies, and what other drivers have earned, in one directory.

``page.json`` is read first; names of files are relative to it. All texts are UTF-8, all numbers finite.

    page.json     {format: 1, version, worlds: [{name, title, id, vehicles, json, wasm, bytes}], in the order of the menu}
    NAME.json     what :mod:`mo_deepdrive.device.wasm` says of a world, and
        scene         {lanes, roads: [{line, width, giveWay}], centre, laneWidth, arrivalRadius, vehicle: [length,
                      width], box: [left, bottom, side], frequency}: as in the scenes of the explorer
        seeds         the seeds that the page offers, of the test split, in order
        policies      [{name, label, file, bytes, conditioned}], learners whose networks the page runs
        drivers       [{name, label, returns: [[d] by seed], ends: [by seed]}]: rules, learners and planned drives on
                      these seeds; of several vehicles, those of vehicle 0 where all drive by the name
        ghost         null, or [actions by seed]: the best known drive of every seed, as texts, see below
        front         [{name, returns: [d]}]: mean returns over the seeds of drives that nothing dominates
        utilities     [{name, label, weights: [d]}], linear ones that are named; u = sum_i weights_i returns_i
        questions     null, or {temperature, samples: [[d]], drives: [{name, label, seed, actions, returns: [d]}]}:
                      see :mod:`mo_deepdrive.evaluation.elicitation`
    POLICY.json   {format, name, label, objectives: [names, of its own d], inputs, scales, activation, layers: [[out,
                  in]], weights, gamma, continuous, preference, checks}
        inputs        which parts the network sees, in this order, joined: "observation" (o), "accrued" (d, the sum of
                      gamma^i r_i so far), "discount" (1, gamma^t), "preference" (d, weights that add up to 1)
        scales        one number for every entry of the input, by which it is divided
        activation    of all but the last layer: "relu" or "tanh"
        weights       base64 of float32, little-endian: of every layer the matrix by rows [out][in], then the biases
        continuous    whether the outputs are means, to be clipped to [-1, 1]; otherwise logits, the greedy action being
                      the first greatest one
        preference    null, or [weights]: of a conditioned policy, where it starts

Actions as texts are runs of equal ones, :func:`mo_deepdrive.world.action_sequences.encode`: "d12a" is 12 times action 3
and once action 0; continuous ones are "steer,acceleration[,brake][*times]", separated by spaces, in 1/1024, without the
brake where it is -1024.

A link is ``#drive=PAYLOAD.CHECK``: PAYLOAD is base64url without padding of the JSON {format: 1, version, id, arguments,
seed, driver, actions: [a text for each of the V vehicles]}, CHECK eight hexadecimal digits of the CRC-32 of PAYLOAD
(its ASCII characters). Vehicles that have ended need no further actions. ``mo-deepdrive replay LINK`` reads it.
"""
