"""One world as a WebAssembly module, from the functions that move it on a CPU, and what a page has to know about it.

Numba makes LLVM code of the kernel, llvmlite makes an object file of it, and ``wasm-ld`` a module of some 100 kB. All
arrays are in the module, with their first contents; the number in brackets is the type in JavaScript. It exports

    memory
    seed(n)       n a BigInt below 2**64: the stream of ``env.reset(seed=n)`` (PCG64, as NumPy seeds it); draws nothing
    restart()     begins the next episode of the stream: the first one after ``seed`` is that of ``env.reset(seed=n)``
    step()        one decision by ``actions``; leaves a world whose episode is over as it is
    keys(v, accelerate, brake, left, right)     the discrete action of vehicle v for keys (0 or 1) that are held down
    worlds, actions, observations, rewards, acted, ended, timed_out     addresses (WebAssembly.Global, use ``.value``)

and imports functions of ``Math`` by their names, all from ``env``: ``new Proxy(Math, ...)`` or ``{env: {exp: Math.exp,
...}}`` with what ``WebAssembly.Module.imports`` lists (``fmod`` is ``(a, b) => a % b``). ``restart`` and ``step`` return
0, or 1 if there was no valid scenario, or an action was not one of those that there are (then nothing has moved).

With V vehicles, d objectives and o observed entries, one after the other:

    worlds        (V) records, see ``state``
    actions       (V) int32, or (V, 3) float32 in [-1, 1] if they are continuous; read by ``step``, of ended vehicles, too
    observations  (V, o) float32, after ``restart`` and ``step``
    rewards       (V, d) float32 of the decision, all maximised; 0 for vehicles that had ended before
    acted         (V) uint8, whether a vehicle was on the road before the decision
    ended         (V) uint8, whether it has ended before the time limit
    timed_out     (V) uint8, whether it has ended by the time limit; all ended or timed out: the episode is over

A return is the sum of ``rewards`` in double precision. The JSON beside the module (:func:`describe`) has

    format, version       1, and the version of the package
    id, arguments         of the environment
    title                 of the scenario
    scenario              its name
    vehicles, frequency   V, and decisions per second
    continuous            whether actions are
    actionNames           of the discrete actions, in order, or of the three axes
    maxDecisions          after which an episode is cut off
    objectives            [{key, name, unit, sign, scale}]: +1 for gains and -1 for costs, whose returns are negative;
                          ``scale`` is nominal, of a return
    observations          [{name, unit, scale}]
    ends                  reasons, by the code in ``state.fields.end``; "" while driving
    state                 {size, fields: {name: [offset, type, count]}}: of a vehicle, in bytes, types of NumPy such as
                          "f8", "i8", "b1"; count of numbers, such as 6 for the three waypoints (x, y)
    cars                  {offset, size, count, fields}, likewise: within the record of vehicle 0; empty if there are none
    obstacles             {offset, count}: 4 doubles each, the two ends, within the record of vehicle 0

Lengths are metres, angles radians, counterclockwise, 0 along y: the direction of a vehicle is (-sin, cos) of its
``heading`` (its ``cos_heading`` and ``sin_heading`` are in the state); (x, y) is its centre. Its destination is the last
of its first ``n_waypoints`` ``waypoints``, or on roads of segments the end of its road, ``route``.
"""
