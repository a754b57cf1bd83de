"""A linear-Gaussian controller that continues to learn, in C: `jaxpg.online` with one environment, the robot itself."""

from __future__ import annotations

import numpy as np

from jaxpg.deploy.controller import Controller, Learner

CODE = """
/* Learning. After every step, with the features x of an observation s and x' of the next one,

     delta   = {scale} reward + gamma V(s') - V(s),      V(s) = w'x + c,      gamma = 0 where the task has ended
     z_w     = gamma lambda_critic z_w + grad V(s)
     z_theta = gamma lambda_actor z_theta + {discounted} grad log N(u; W'x + b, sigma^2)
     w += alpha_critic delta z_w,    theta += alpha_actor delta z_theta

   with the parameters theta = (W, b{sigma}). Steps are not bounded: try new step sizes in simulation first. But
   numbers that are not finite are never learned from. */
#define POLICY_FEATURES {size}

typedef struct {{
    policy_real weight[POLICY_FEATURES * POLICY_COMMANDS], bias[POLICY_COMMANDS], log_sigma[POLICY_COMMANDS];
    policy_real value_weight[POLICY_FEATURES], value_bias;
}} policy_parameters;

typedef struct {{
    policy_parameters parameters, traces;
    policy_real factor; /* gamma^t where the gradient is discounted, else 1 */
}} policy_learner;

/* Clears the traces, as before the first step of an episode. */
static inline void policy_forget(policy_learner *learner) {{
    policy_parameters *z = &learner->traces;
    for (int i = 0; i < POLICY_FEATURES * POLICY_COMMANDS; i++) z->weight[i] = 0;
    for (int j = 0; j < POLICY_COMMANDS; j++) z->bias[j] = z->log_sigma[j] = 0;
    for (int i = 0; i < POLICY_FEATURES; i++) z->value_weight[i] = 0;
    z->value_bias = 0;
    learner->factor = 1;
}}

/* A learner with the trained parameters. */
static inline void policy_begin(policy_learner *learner) {{
    policy_parameters *p = &learner->parameters;
    for (int i = 0; i < POLICY_FEATURES * POLICY_COMMANDS; i++) p->weight[i] = policy_weight_0[i];
    for (int j = 0; j < POLICY_COMMANDS; j++) p->bias[j] = policy_bias_0[j];
    for (int j = 0; j < POLICY_COMMANDS; j++) p->log_sigma[j] = policy_log_sigma[j];
    for (int i = 0; i < POLICY_FEATURES; i++) p->value_weight[i] = policy_value_weight[i];
    p->value_bias = policy_value_bias[0];
    policy_forget(learner);
}}

/* Computes u = mean + sigma noise from the caller's independent standard normal numbers, and the command for u.
   Returns as policy_command does. */
static inline int policy_sample(const policy_learner *learner, const policy_real observation[POLICY_OBSERVATIONS],
                                const policy_real noise[POLICY_COMMANDS], policy_real u[POLICY_COMMANDS],
                                policy_real command[POLICY_COMMANDS]) {{
    const policy_parameters *p = &learner->parameters;
    policy_real x[POLICY_FEATURES];
    const int valid = policy_features(observation, x);
    policy_layer(p->weight, p->bias, POLICY_FEATURES, POLICY_COMMANDS, x, u);
    for (int j = 0; j < POLICY_COMMANDS; j++) u[j] += POLICY_F(exp)(p->log_sigma[j]) * noise[j];
    return valid ? policy_limited(u, command) : policy_no_command(command);
}}

static inline policy_real policy_value(const policy_learner *learner, const policy_real *x) {{
    policy_real value = learner->parameters.value_bias;
    for (int i = 0; i < POLICY_FEATURES; i++) value += learner->parameters.value_weight[i] * x[i];
    return value;
}}

/* Learns from one step. `terminated`: the task has ended, and no more reward follows; `truncated`: the episode was
   cut, for example by a time limit, and the next step begins another one. In either case `next_observation` is the last
   one of the episode. Returns 1; or 0, with the traces cleared and nothing learned, if u or the TD error is not finite
   or an observation is not valid (after termination the next one does not matter). */
static inline int policy_update(policy_learner *learner, const policy_real observation[POLICY_OBSERVATIONS],
                                const policy_real u[POLICY_COMMANDS], policy_real reward,
                                const policy_real next_observation[POLICY_OBSERVATIONS], int terminated,
                                int truncated) {{
    const policy_real gamma = policy_constants[0];
    const policy_real keep_actor = gamma * policy_constants[1], keep_critic = gamma * policy_constants[2];
    policy_parameters *p = &learner->parameters, *z = &learner->traces;
    policy_real x[POLICY_FEATURES], next[POLICY_FEATURES], mean[POLICY_COMMANDS];
    int valid = policy_features(observation, x);
    valid &= policy_features(next_observation, next) || terminated;
    policy_layer(p->weight, p->bias, POLICY_FEATURES, POLICY_COMMANDS, x, mean);
    const policy_real bootstrap = terminated ? 0 : gamma * policy_value(learner, next);
    const policy_real delta = policy_constants[5] * reward + bootstrap - policy_value(learner, x);
    const policy_real step_actor = policy_constants[3] * delta, step_critic = policy_constants[4] * delta;
    valid &= policy_finite(delta);
    for (int j = 0; j < POLICY_COMMANDS; j++) valid &= policy_finite(u[j]);
    if (!valid) {{
        policy_forget(learner);
        return 0;
    }}

    for (int i = 0; i < POLICY_FEATURES; i++) {{
        z->value_weight[i] = keep_critic * z->value_weight[i] + x[i];
        p->value_weight[i] += step_critic * z->value_weight[i];
    }}
    z->value_bias = keep_critic * z->value_bias + 1;
    p->value_bias += step_critic * z->value_bias;
    for (int j = 0; j < POLICY_COMMANDS; j++) {{
        const policy_real away = (u[j] - mean[j]) * POLICY_F(exp)(-p->log_sigma[j]);
        const policy_real score = learner->factor * away * POLICY_F(exp)(-p->log_sigma[j]);
        for (int i = 0; i < POLICY_FEATURES; i++) {{
            policy_real *trace = &z->weight[i * POLICY_COMMANDS + j];
            *trace = keep_actor * *trace + score * x[i];
            p->weight[i * POLICY_COMMANDS + j] += step_actor * *trace;
        }}
        z->bias[j] = keep_actor * z->bias[j] + score;
        p->bias[j] += step_actor * z->bias[j];{learn_sigma}
    }}
    learner->factor *= {factor};
    if (terminated || truncated) policy_forget(learner);
    return 1;
}}
"""

LEARN_SIGMA = """
        z->log_sigma[j] = keep_actor * z->log_sigma[j] + learner->factor * (away * away - 1);
        p->log_sigma[j] += step_actor * z->log_sigma[j];"""

EXAMPLE = """\
/* Reads steps from standard input: observation, u, reward, next observation, terminated, truncated.
   After each step, writes a line with all parameters: W, b, log sigma, w, c. */
#include <stdio.h>

#include "policy.h"

static int read_numbers(policy_real *numbers, int count) {
    double number;
    for (int i = 0; i < count; i++) {
        if (scanf("%lf", &number) != 1) return 0;
        numbers[i] = (policy_real)number;
    }
    return 1;
}

static void print(const policy_real *numbers, int count) {
    for (int i = 0; i < count; i++) printf("%.17g ", (double)numbers[i]);
}

int main(void) {
    policy_learner learner;
    policy_real s[POLICY_OBSERVATIONS], u[POLICY_COMMANDS], reward, next[POLICY_OBSERVATIONS], ended[2];
    policy_begin(&learner);
    while (read_numbers(s, POLICY_OBSERVATIONS) && read_numbers(u, POLICY_COMMANDS) && read_numbers(&reward, 1) &&
           read_numbers(next, POLICY_OBSERVATIONS) && read_numbers(ended, 2)) {
        const policy_parameters *p = &learner.parameters;
        policy_update(&learner, s, u, reward, next, ended[0] > 0, ended[1] > 0);
        print(p->weight, POLICY_FEATURES * POLICY_COMMANDS);
        print(p->bias, POLICY_COMMANDS);
        print(p->log_sigma, POLICY_COMMANDS);
        print(p->value_weight, POLICY_FEATURES);
        print(&p->value_bias, 1);
        printf("\\n");
    }
    return 0;
}
"""


def make_code(controller: Controller, learner: Learner) -> str:
    """The second part of the header, about a controller called `policy`."""
    options = learner.options
    return CODE.format(
        size=len(controller.layers[0].weight),
        scale=f"{options.reward_scale:g}",
        discounted="gamma^t" if options.discounted else "1",
        sigma=", log sigma" if learner.learns_sigma else "",
        learn_sigma=LEARN_SIGMA if learner.learns_sigma else "",
        factor="gamma" if options.discounted else "1",
    )


def make_arrays(learner: Learner) -> dict[str, np.ndarray]:
    """The constants of the second part, by name: learned numbers in float32, options in float64."""
    options = learner.options
    numbers = (options.gamma, options.lambda_actor, options.lambda_critic, options.actor_lr, options.critic_lr)
    return {
        "log_sigma": learner.log_std,
        "value_weight": learner.value.weight,
        "value_bias": learner.value.bias,
        "constants": np.array([*numbers, options.reward_scale]),
    }
