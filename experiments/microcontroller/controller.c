/* The controller and nothing else: the size of this file's object is what it adds to a program. */
#include "policy.h"

void command(const float *observation, float *commands);

void command(const float *observation, float *commands) { policy_command(observation, commands); }
