/* The generated kinematic core, in CasADi's calling convention: inputs and outputs by pointer, `w` scratch of N_WORK. */
#ifndef KINEMATICS_H
#define KINEMATICS_H

/* s, p, play -> the ball in the camera frame or other features, and which of them are seen (2 m) */
int arm_feature(const double **arg, double **res, int *iw, double *w, int mem);
/* s, p, play -> Jacobian of the features, row-major (m x N_JOINTS) */
int arm_jacobian(const double **arg, double **res, int *iw, double *w, int mem);
/* s, p, play -> place and velocity of the target of a rigid tool (6), derivatives of the tool's states (6) */
int arm_motion(const double **arg, double **res, int *iw, double *w, int mem);
/* s, p, play, ds, dp -> derivatives of features and Jacobian, and of those of the tool's states, along (ds, dp) */
int arm_forward(const double **arg, double **res, int *iw, double *w, int mem);

#endif
