# shellcheck shell=bash
# The commands of all runs in this folder, each a line of its own: copy one, and run it from the
# repository's root. What is complete is passed over. Those of plans.md are here, run or not.

# reproduction.csv: the paper's protocol
./run_sweep.sh main --runs-dir reproduction --betas "0 0.5 1" --n-envs 4 --seeds "1 2 3 4 5" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse cartpole-swingup_sparse ball_in_cup-catch cheetah-run reacher-hard"
./run_sweep.sh main --runs-dir reproduction --betas "0 0.5 1" --n-envs 32 --seeds "1 2 3 4 5" --envs pendulum-swingup
python -m study.runs pack reproduction/ results/reproduction.csv --overwrite

# study.csv: more environments and n_envs, 10 episodes instead of 50 in an evaluation
./run_sweep.sh main --runs-dir study_runs --betas "0 0.5 1" --n-envs 4 --seeds "1 2 3 4 5" --envs "hopper-hop walker-run door-v0 PointUMaze Point4Rooms SwimmerUMaze AntUMaze Ant4Rooms" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas "0 0.5 1" --n-envs 4 --seeds "4 5" --envs Swimmer4Rooms -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas "0 0.5 1" --n-envs "1 32" --seeds "1 2 3" --envs "pendulum-swingup MountainCarContinuous cartpole-balance_sparse reacher-hard cartpole-swingup_sparse cheetah-run PointUMaze Point4Rooms hopper-hop" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas "0.5 1" --n-envs 1 --seeds "$(echo {101..110})" --envs pendulum-swingup -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas "0.2 0.5 0.75" --n-envs 4 --seeds "$(echo {101..110})" --envs pendulum-swingup -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas 0.2 --n-envs 4 --seeds "$(echo {401..420})" --envs MountainCarContinuous -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_runs --betas 0 --n-envs 4 --seeds "$(echo {401..468})" --envs MountainCarContinuous -- --eval-episodes 10 --eval-once-per-policy
python -m study.runs pack study_runs/ results/study.csv --overwrite

# study_n_envs.csv: the same in the seven environments that lacked n_envs 1 and 32
./run_sweep.sh main --runs-dir study_n_envs --betas "0 0.5 1" --n-envs "1 32" --seeds "1 2" --envs "SwimmerUMaze walker-run ball_in_cup-catch door-v0 AntUMaze" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir study_n_envs --betas "0 0.5 1" --n-envs "1 32" --seeds "3 4" --envs "Swimmer4Rooms Ant4Rooms" -- --eval-episodes 10 --eval-once-per-policy
python -m study.runs pack study_n_envs/ results/study_n_envs.csv --overwrite

# same_swimmer.csv: in no average, since they are runs of SwimmerUMaze in all but the name
./run_sweep.sh main --runs-dir same_swimmer --betas "0 0.5 1" --n-envs 4 --seeds "1 2 3" --envs Swimmer4Rooms -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh main --runs-dir same_swimmer --betas "0 0.5 1" --n-envs "1 32" --seeds 1 --envs Swimmer4Rooms -- --eval-episodes 10 --eval-once-per-policy
python -m study.runs pack same_swimmer/ results/same_swimmer.csv --overwrite

# slices.csv: Sec. A6, A8, A11 and A12
./run_sweep.sh vanilla --runs-dir slices --n-envs 4 --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse reacher-hard" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh n_steps --runs-dir slices --n-envs "2 8" --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse reacher-hard" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh n_epochs --runs-dir slices --betas 0.5 --n-epochs "5 20" --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse reacher-hard" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh n_epochs --runs-dir slices --betas "0.2 0.75" --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse reacher-hard" -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh complex --runs-dir slices --betas "0 0.5 1" --seeds "1 2 3" --envs PointPush -- --eval-episodes 10 --eval-once-per-policy
./run_sweep.sh complex --runs-dir slices --betas "0 0.5 1" --seeds 1 --envs "PointPushMaze AntPush" -- --eval-episodes 10 --eval-once-per-policy
python -m study.runs pack slices/ results/slices.csv --overwrite

# methods.csv: TRPO, A2C and gSDE, and PPO with the two reddest noises of the study
./run_sweep.sh transfer --runs-dir methods --betas "0 0.5" --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse" -- --eval-episodes 10
./run_sweep.sh gsde --runs-dir methods --n-envs 4 --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse" -- --eval-episodes 10
./run_sweep.sh main --runs-dir methods --betas "1.25 2" --n-envs 4 --seeds "1 2 3" --envs "MountainCarContinuous pendulum-swingup cartpole-balance_sparse" -- --eval-episodes 10 --eval-once-per-policy
python -m study.runs pack methods/ results/methods.csv --overwrite

# bootstrapped_timeouts.csv: dm_control with the script's default at time limits
./run_sweep.sh main --runs-dir bootstrapped --envs "pendulum-swingup cartpole-balance_sparse" --betas "0 0.5 1" --n-envs 4 --seeds "1 2 3" -- --bootstrap-timeouts
./run_sweep.sh main --runs-dir bootstrapped --envs pendulum-swingup --betas "0 0.5 1" --n-envs 32 --seeds "1 2 3" -- --bootstrap-timeouts
python -m study.runs pack bootstrapped/ results/bootstrapped_timeouts.csv --overwrite

# variants.csv: first searches for causes
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name no_bootstrap --envs "cartpole-balance_sparse pendulum-swingup" --betas 1 --seeds "1 2 3 4 5" -- --eval-freq 204800 --eval-episodes 10
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name no_bootstrap --envs reacher-hard --betas 0 --seeds "6 7 8 9 10 11" -- --eval-freq 204800 --eval-episodes 10
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name no_bootstrap --envs cartpole-swingup_sparse --betas 0 --seeds "6 7" -- --eval-freq 204800 --eval-episodes 10
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name noise_seq_len_1024 --envs pendulum-swingup --betas 1 --seeds "1 2 3 4 5 6 7 8 9 10 11 12" -- --eval-freq 204800 --eval-episodes 10 --noise-seq-len 1024
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name released_code --envs pendulum-swingup --betas 1 --seeds "1 2 3 4 5 6" -- --eval-freq 204800 --eval-episodes 10 --batch-size 64 --noise-seq-len 1024
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name batch_size_64_no_bootstrap --envs pendulum-swingup --betas 1 --seeds "1 2 3 4 5 6" -- --eval-freq 204800 --eval-episodes 10 --batch-size 64
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name batch_size_64 --envs pendulum-swingup --betas 1 --seeds "1 2" -- --eval-freq 204800 --eval-episodes 10 --bootstrap-timeouts --batch-size 64
./run_sweep.sh main --runs-dir variants --n-envs 4 --exp-name more_seeds --envs pendulum-swingup --betas 1 --seeds "3 4 5 6 7 8 9" -- --eval-freq 204800 --eval-episodes 10 --bootstrap-timeouts
python -m study.runs pack variants/ results/variants.csv --overwrite

# noise_length.csv: T = 1000 and 1024
./run_sweep.sh main --runs-dir noise_length --exp-name T1000 --n-envs 4 --betas 1 --seeds "$(echo {101..110})" --envs "pendulum-swingup cartpole-swingup_sparse" -- --eval-episodes 10 --noise-seq-len 1000
./run_sweep.sh main --runs-dir noise_length --exp-name T1024 --n-envs 4 --betas 1 --seeds "$(echo {101..110})" --envs "pendulum-swingup cartpole-swingup_sparse" -- --eval-episodes 10 --noise-seq-len 1024
python -m study.runs pack noise_length/ results/noise_length.csv --overwrite

# new_seeds.csv: cells that seemed off, run anew
./run_sweep.sh main --runs-dir new_seeds --exp-name batch_size_128 --n-envs "4 1" --betas 0 --seeds "$(echo {101..110} {201..220})" --envs pendulum-swingup -- --eval-freq 204800 --eval-episodes 10
./run_sweep.sh main --runs-dir new_seeds --exp-name batch_size_64 --n-envs "4 1" --betas 0 --seeds "$(echo {101..110})" --envs pendulum-swingup -- --eval-freq 204800 --eval-episodes 10 --batch-size 64
./run_sweep.sh main --runs-dir new_seeds --exp-name batch_size_128 --n-envs 4 --betas "0 0.5" --seeds "$(echo {101..110})" --envs cartpole-swingup_sparse -- --eval-freq 204800 --eval-episodes 10
./run_sweep.sh main --runs-dir new_seeds --exp-name batch_size_64 --n-envs 4 --betas "0 0.5" --seeds 101 --envs cartpole-swingup_sparse -- --eval-freq 204800 --eval-episodes 10 --batch-size 64
./run_sweep.sh main --runs-dir new_seeds --exp-name bootstrap --n-envs "4 1" --betas 0 --seeds "$(echo {101..110})" --envs pendulum-swingup -- --eval-freq 204800 --eval-episodes 10 --bootstrap-timeouts
./run_sweep.sh main --runs-dir new_seeds --exp-name batch_size_128 --n-envs "32 128" --betas 0 --seeds "$(echo {101..110})" --envs MountainCarContinuous -- --eval-freq 204800 --eval-episodes 10
python -m study.runs pack new_seeds/ results/new_seeds.csv --overwrite

# released_code.csv: batches and sequences as in the paper's released code
./run_sweep.sh main --runs-dir released_code --betas 0.2 --n-envs 4 --seeds "$(echo {401..420})" --envs MountainCarContinuous -- --eval-freq 204800 --eval-episodes 10 --batch-size 64 --noise-seq-len 1024
python -m study.runs pack released_code/ results/released_code.csv --overwrite

# sb3.csv: the paper's stack on today's versions
for SEED in {1..20}; do python -m study.sb3 --runs-dir sb3 --env-id dm_control/pendulum-swingup-v0 --vanilla --n-envs 1 --no-bootstrap-timeouts --eval-freq 204800 --eval-episodes 10 --seed "$SEED"; done
python -m study.runs pack sb3/ results/sb3.csv --overwrite

# gymnasium.csv: Gymnasium's MuJoCo tasks with the settings in use today
./run_sweep.sh gymnasium --runs-dir gymnasium
python -m study.runs pack gymnasium/ results/gymnasium.csv --overwrite

# gymnasium_baseline.csv: why white noise is low in Ant-v5 and Swimmer-v5, and whether the lead of
# beta 0.5 in Ant-v5 hangs on it
./run_sweep.sh gymnasium --runs-dir baseline --envs Ant-v5 --betas 0 --n-envs 1 --seeds "1 2 3" -- --env-kwargs '{"include_cfrc_ext_in_observation": false}'
./run_sweep.sh gymnasium --runs-dir baseline --envs Ant-v5 --betas "0 0.5" --n-envs 32 -- --env-kwargs '{"include_cfrc_ext_in_observation": false}'
./run_sweep.sh gymnasium --runs-dir baseline --envs Swimmer-v5 --betas 0 --n-envs 1 --seeds "1 2 3" -- --gamma 0.9999
python -m study.runs pack baseline/ results/gymnasium_baseline.csv --overwrite
