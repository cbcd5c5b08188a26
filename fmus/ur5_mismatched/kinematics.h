/* The generated kinematic core, in CasADi's calling convention: inputs and outputs by pointer, `w` scratch of N_WORK. */
#ifndef KINEMATICS_H
#define KINEMATICS_H

/* q, p -> ball in the camera frame (3) */
int arm_ball(const double **arg, double **res, int *iw, double *w, int mem);
/* q, p -> Jacobian, row-major (3 x N_JOINTS) */
int arm_jacobian(const double **arg, double **res, int *iw, double *w, int mem);
/* q, p, dq, dp -> derivatives of ball (3) and Jacobian (3 x N_JOINTS) along (dq, dp) */
int arm_forward(const double **arg, double **res, int *iw, double *w, int mem);

#endif
