/* The generated functions; they return the code of a fault, or 0. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

/* x = x(0) for u; y is not used */
double controller_start(double *x, const double *u, double *y);
/* x(k) becomes x(k+1), y = y(k) */
double controller_step(double *x, const double *u, double *y);

#endif
