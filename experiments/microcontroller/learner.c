/* The learner and nothing else: its parameters and traces are the only variables. */
#include "policy.h"

extern policy_learner learner;
void update(const float *step);

policy_learner learner;

/* A step: observation, u, reward, next observation, terminated, truncated. */
void update(const float *step) {
    const float *u = step + POLICY_OBSERVATIONS, *reward = u + POLICY_COMMANDS, *next = reward + 1;
    const float *ended = next + POLICY_OBSERVATIONS;
    policy_update(&learner, step, u, *reward, next, ended[0] > 0, ended[1] > 0);
}
