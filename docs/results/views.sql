-- What the made tables of the documentation select from: views of the CSV files in this folder and of the suite's tasks.

CREATE VIEW installing AS -- README: the two commands, how long they take, and what is installed
SELECT '`' || command || '`' AS command, does AS "what it does", prints AS "what it prints last",
  minutes AS "minutes on two cores, beside the installation",
  gigabytes AS "GB installed, with PyTorch's CPU build" FROM install;

CREATE VIEW suite_list AS -- scoreboard: the tasks that count, and their best learners
SELECT '`' || task || '`' AS task, title, tests AS "what it tests", printf('%g M', steps / 1e6) AS steps,
  best AS "best learner", score, core
FROM suite_tasks WHERE counted;

CREATE VIEW suite_core AS -- README: what the core tasks pay, between which bounds, and who is best
SELECT '`' || task || '`' AS task, score, best AS "best, or tied for it", printf('%g', floor) AS "floor (0)",
  printf('%g', ceiling) AS "ceiling (1)", (SELECT decimals(avg(cpu_seconds) / 60.0, 0) FROM (SELECT DISTINCT seed, cpu_seconds
    FROM suite WHERE suite.task = t.task AND suite.learner = t.first AND cpu_seconds <> '')) AS "CPU minutes",
  title, '`' || formula || '`' AS utility
FROM suite_tasks AS t WHERE counted AND core;

CREATE VIEW suite_generalisation AS -- scoreboard: scores of the best learners where nobody has trained
WITH scored AS (
  SELECT task, best, suite."column" AS setting, max(-1.0, (value - floor) / (ceiling - floor)) AS score
  FROM suite JOIN suite_tasks AS t USING (task, policy) WHERE value <> '' AND counted AND learner = first)
SELECT '`' || task || '`' AS task, best AS learner,
  decimals(avg(CASE setting WHEN 'score' THEN score END), 2) AS "as trained",
  decimals(avg(CASE setting WHEN 'yaw_friction' THEN score END), 2) AS "less grip",
  decimals(avg(CASE setting WHEN 'action_delay' THEN score END), 2) AS "delayed actions",
  decimals(avg(CASE setting WHEN 'hidden_car' THEN score END), 2) AS "a hidden car"
FROM scored GROUP BY scored.task;

CREATE VIEW gpu_speed AS -- docs/gpu.md
SELECT measurement, device, CASE
  WHEN measurement LIKE 'make_vec-roundabout%' THEN '`make_vec`, 8 vehicles in the roundabout'
  WHEN measurement LIKE 'make_vec-%' THEN '`make_vec`, ' || CASE substr(measurement, 10)
    WHEN 'one-waypoint' THEN 'OneWaypoint' WHEN 'static-obstacle' THEN 'StaticObstacle'
    WHEN 'intersection' THEN 'Intersection' WHEN 'left-turn' THEN 'LeftTurn' END
  ELSE 'training ten seeds of `' || measurement || '`' END AS what,
  printf('%,d', 1000 * cast(round(old / 1000.0) AS INTEGER)) AS "one thread, steps/s",
  printf('%,d', 100000 * cast(round(new / 100000.0) AS INTEGER)) AS "GPU, steps/s", printf('%.0f', speedup) AS "speed-up"
FROM benchmark_gpu ORDER BY measurement LIKE '%/%';

CREATE VIEW roundabout_drivers AS -- roundabout, roundabout_solo: floors, rules and learners, the best one first
SELECT task, driver, CASE kind WHEN 'learner' THEN count(*) END AS seeds,
  decimals(100 * avg(arrived), 1) AS "arrived (%)", decimals(100 * avg(collided), 1) AS "collided (%)",
  decimals(avg(utility), 2) || CASE WHEN count(*) > 1
    THEN ' (' || decimals(min(utility), 2) || ' to ' || decimals(max(utility), 2) || ')' ELSE '' END AS utility,
  decimals(avg(worst_off), 2) AS "worst-off", decimals(avg(gini), 2) AS Gini, decimals(-avg(time), 1) AS "time (s)",
  decimals(-avg(jerk), 0) AS "jerk (m/s³)", decimals(-avg(near_miss), 2) AS "near misses",
  decimals(-avg(right_of_way), 2) AS "right of way (m/s)"
FROM roundabout GROUP BY task, driver ORDER BY avg(utility) DESC;

CREATE VIEW roundabout_preferences AS -- roundabout: what a driver of a kind gets among seven of a kind
WITH met AS (
  SELECT 'rule' AS driver, replace(vehicle_0, 'rule:', '') AS one, replace(others, 'rule:', '') AS other,
    "vehicle_0/utility_esr" AS utility, "vehicle_0/success" AS arrived, "vehicle_0/return/time" AS time,
    "vehicle_0/return/near_miss" AS near
  FROM roundabout_types_cross_play
  UNION ALL
  SELECT 'conditioned MO-PPO', vehicle_0, others,
    "vehicle_0/utility_esr", "vehicle_0/success", "vehicle_0/return/time", "vehicle_0/return/near_miss"
  FROM roundabout_preferences_cross_play),
cells AS (
  SELECT driver, one, other,
    printf('%.1f (%.0f%%, %.1f s, %.2f)', utility, 100 * arrived, -time, -near) AS cell FROM met)
SELECT driver || ', ' || one AS driver,
  max(CASE other WHEN 'hurried' THEN cell END) AS "among hurried",
  max(CASE other WHEN 'balanced' THEN cell END) AS "among balanced",
  max(CASE other WHEN 'careful' THEN cell END) AS "among careful"
FROM cells GROUP BY cells.driver, one ORDER BY cells.driver DESC, instr('hurried balanced careful', one);

CREATE VIEW roundabout_strangers AS -- roundabout: arrivals and utility of a driver among seven that it has and has not met
WITH met AS (
  SELECT CASE WHEN vehicle_0 LIKE 'rule:%' THEN replace(vehicle_0, 'rule:', 'rule, ')
      ELSE 'MO-PPO, seed ' || substr(vehicle_0, instr(vehicle_0, 'seed') + 4, 1) END AS driver,
    CASE WHEN vehicle_0 = others THEN 'own' WHEN others LIKE 'rule:%' THEN 'rules' ELSE 'runs' END AS who,
    "vehicle_0/success" AS arrived, "vehicle_0/utility_esr" AS utility
  FROM roundabout_strangers_cross_play),
cells AS (
  SELECT driver, who, printf('%.0f%% (%.1f)', 100 * avg(arrived), avg(utility)) AS cell FROM met GROUP BY driver, who)
SELECT driver, max(CASE who WHEN 'own' THEN cell END) AS "own partners",
  max(CASE who WHEN 'runs' THEN cell END) AS "runs of other seeds",
  max(CASE who WHEN 'rules' THEN cell END) AS "20 scripted strangers"
FROM cells GROUP BY driver ORDER BY driver;

CREATE VIEW provenance_changes AS -- provenance: what has changed learning
SELECT rowid AS number, substr(date, 1, 10) AS date, '`' || "commit" || '`' AS "commit", kind AS learners, change FROM changes;

CREATE VIEW provenance_results AS -- provenance: every file of results
SELECT '`' || file || '`' AS result, part, replace('`' || "commit" || '`', ' ', '` to `') AS "commit", substr(date, 1, 10) AS date,
  '`' || command || '`' AS "made by", (
  SELECT group_concat(c.rowid, ', ') FROM changes AS c WHERE c.rowid > made.changes AND (c.kind = made.kind OR 'learners' IN (c.kind, made.kind)
    AND made.kind IN ('learners', 'actor-critics', 'conditioned', 'pcn'))) AS "changed since"
FROM provenance AS made ORDER BY file, date;

CREATE VIEW provenance_zoo AS -- provenance: the policies of the zoo
SELECT '`' || substr("commit", 1, 8) || '`' AS "commit", '`' || group_concat(policy, '`, `') || '`' AS policies FROM zoo GROUP BY "commit";

CREATE VIEW use_with AS -- use_with: other libraries, in the versions that the constraints pin
WITH libraries(title, anchor, package, extra, single, several, reward) AS (VALUES
  ('Gymnasium', 'gymnasium', 'gymnasium', NULL, '`make`, `make_vec`', '`make_vec`; `make` in turns', 'vector'),
  ('MO-Gymnasium', 'gymnasium', 'mo-gymnasium', NULL, '`mo_gymnasium.make`', NULL, 'vector'),
  ('Stable-Baselines3', 'stable-baselines3', 'stable-baselines3', 'sb3', '`SB3VecEnv`', 'with SuperSuit', 'utility'),
  ('CleanRL', 'cleanrl', NULL, NULL, '`make_vec`', '`make_vec`', 'utility'),
  ('morl-baselines', 'morl-baselines', 'morl-baselines', 'peers', '`mo_gymnasium.make`', 'with MOMAland', 'vector'),
  ('RLlib', 'rllib', 'ray', 'rllib', '`DrivingMultiAgentEnv`', '`DrivingMultiAgentEnv`', 'utility'),
  ('PettingZoo', 'pettingzoo', 'pettingzoo', NULL, '`parallel_env`', '`parallel_env`, `env`', 'vector'),
  ('MOMAland', 'momaland', 'momaland', 'momaland', '`parallel_env`', '`parallel_env`, `env`', 'vector'),
  ('Minari', 'minari', 'minari', 'minari', '`record_dataset`', NULL, 'vector'),
  ('ONNX Runtime', 'onnx', 'onnxruntime', 'onnx', '`mo-deepdrive export`', '`mo-deepdrive export`', NULL),
  ('TorchRL', 'torchrl-tianshou-supersuit', 'torchrl', NULL, '`MOGymEnv`', '`PettingZooWrapper`', 'vector, utility'),
  ('Tianshou', 'torchrl-tianshou-supersuit', 'tianshou', NULL, '`UtilityReward`', '`PettingZooEnv`', 'vector, utility'),
  ('SuperSuit', 'torchrl-tianshou-supersuit', 'supersuit', NULL, '`gym_vec_env_v0`', '`concat_vec_envs_v1`', 'vector'))
SELECT '[' || title || '](#' || anchor || ')' AS library, version, '`' || extra || '`' AS extra, single AS "one vehicle",
  several AS "several vehicles", reward FROM libraries LEFT JOIN pins USING (package);
