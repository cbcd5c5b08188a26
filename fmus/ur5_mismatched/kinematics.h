/* The generated kinematic core, in CasADi's calling convention: inputs and outputs by pointer, `w` scratch of N_WORK. */
#ifndef KINEMATICS_H
#define KINEMATICS_H

/* q, p -> the ball in the camera frame or other features, and which of them are seen (2 m) */
int arm_feature(const double **arg, double **res, int *iw, double *w, int mem);
/* q, p -> Jacobian of the features, row-major (m x N_JOINTS) */
int arm_jacobian(const double **arg, double **res, int *iw, double *w, int mem);
/* q, p, dq, dp -> derivatives of both, the Jacobian last, along (dq, dp) */
int arm_forward(const double **arg, double **res, int *iw, double *w, int mem);

#endif
