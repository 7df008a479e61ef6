// The rules by which `mo-deepdrive choose` orders policies (algorithms/commands/choose.py), on the same numbers.

/** Mean returns (d) of the episodes (E, d) of a policy. */
const meanReturns = (episodes) => episodes[0].map((_, i) => mean(episodes.map((episode) => episode[i])));

/** To the nearest integer, halves to the even one, as NumPy rounds. */
const roundHalfEven = (value) => (Math.abs(value % 1) === 0.5 ? 2 * Math.round(value / 2) : Math.round(value));

/** Indices of policies, the greatest value first; of equal values, the greater sum of scaled mean returns. */
function rankPolicies(values, means, scales) {
  const largest = Math.max(...values.map(Math.abs));
  const rounded = largest > 0 ? values.map((value) => roundHalfEven((value / largest) * 1e9) / 1e9) : values;
  const overall = means.map((row) => sum(row.map((value, i) => value / scales[i])));
  return values.map((_, k) => k).sort((a, b) => rounded[b] - rounded[a] || overall[b] - overall[a] || a - b);
}

/** Weighted sums (K) of mean returns. */
const weightedSums = (returns, weights) =>
  returns.map((episodes) => mean(episodes.map((episode) => sum(episode.map((value, i) => value * weights[i])))));

/** Expected utilities (K) of a comfort budget: ComfortBudget of mo_deepdrive/utilities.py, mean over episodes. */
function budgetUtilities(returns, objectives, budget) {
  const utility = (episode) => {
    const m = Object.fromEntries(objectives.map(({ key, sign }, i) => [key, episode[i] * sign]));
    return sum([...Object.entries(budget.gains).map(([key, gain]) => gain * m[key]),
      ...Object.entries(budget.excessPrices).map(([key, price]) => -price * Math.max(m[key] - budget[key], 0)),
      ...Object.entries(budget.prices).map(([key, price]) => -price * m[key])]);
  };
  return returns.map((episodes) => mean(episodes.map(utility)));
}

/** Minus the scaled distances (K) by which mean returns fall short of a target. */
const targetCloseness = (means, target, scales) =>
  means.map((row) => -Math.hypot(...row.map((value, i) => Math.max(target[i] - value, 0) / scales[i])));

/** The weight of a return that counts with `importance` (0 to 100), relative to its nominal scale. */
const weightOf = (importance, scale) => Number((importance / 100 / scale).toPrecision(3));

/** For each of the rows (K, d), all maximised, one that dominates it and is itself not dominated, or -1. */
function dominators(rows) {
  const dominates = (a, b) => a.every((value, i) => value >= b[i]) && a.some((value, i) => value > b[i]);
  const on = rows.map((row) => !rows.some((other) => dominates(other, row)));
  return rows.map((row) => rows.findIndex((other, k) => on[k] && dominates(other, row)));
}

/**
 * Policies `k` near `chosen`, of those `among` (booleans) the rows (K, d), all maximised, with the columns in which they are `better`:
 * for each column the nearest that is better by a twentieth of the front's extent, and the nearest that differ by a hundredth.
 */
function alternatives(rows, chosen, among, nearest = 3) {
  const extents = rows[chosen].map((_, i) => Math.max(...rows.map((row) => row[i])) - Math.min(...rows.map((row) => row[i])));
  const apart = (a, b) => rows[a].map((value, i) => (extents[i] > 0 ? (value - rows[b][i]) / extents[i] : 0));
  const others = rows.map((_, k) => k).filter((k) => k !== chosen && among[k])
    .map((k) => ({ k, step: apart(k, chosen), distance: Math.hypot(...apart(k, chosen)) }))
    .sort((a, b) => a.distance - b.distance || a.k - b.k);
  const found = new Map();
  rows[chosen].forEach((_, i) => {
    const best = others.find(({ step }) => step[i] >= 0.05);
    if (best) found.set(best.k, [...(found.get(best.k) ?? []), i]);
  });
  const most = found.size + nearest;
  for (const { k, distance } of others) {
    const differs = distance >= 0.01 && [...found.keys()].every((other) => Math.hypot(...apart(k, other)) >= 0.01);
    if (differs && found.size < most) found.set(k, []);
  }
  return [...found].map(([k, better]) => ({ k, better }));
}
