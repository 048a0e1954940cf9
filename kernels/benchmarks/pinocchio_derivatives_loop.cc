// Pinocchio on one core, one sample after the other: nanoseconds of processor time an evaluation of the derivatives of inverse
// and of forward dynamics.
// Standard input: dof, gravity, then 9 + 3 + 10 numbers a joint (axes by rows, origin, dynamic parameters).
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/rnea-derivatives.hpp>

#include <ctime>
#include <cstdlib>
#include <iostream>
#include <vector>

template <class F>
double nanoseconds(int samples, F f) {
  const std::clock_t start = std::clock();  // of this process: not what others take
  for (int i = 0; i < samples; ++i) f(i);
  return 1e9 * double(std::clock() - start) / CLOCKS_PER_SEC / samples;
}

int main(int, char** argv) {
  namespace pin = pinocchio;
  const int samples = std::atoi(argv[1]);
  int dof;
  Eigen::Vector3d gravity;
  std::cin >> dof >> gravity[0] >> gravity[1] >> gravity[2];
  pin::Model model;
  model.gravity.linear() = gravity;
  pin::JointIndex parent = 0;
  for (int j = 0; j < dof; ++j) {
    Eigen::Matrix3d R;
    Eigen::Vector3d p;
    Eigen::Matrix<double, 10, 1> phi;
    for (int k = 0; k < 9; ++k) std::cin >> R(k / 3, k % 3);
    for (int k = 0; k < 3; ++k) std::cin >> p[k];
    for (int k = 0; k < 10; ++k) std::cin >> phi[k];
    parent = model.addJoint(parent, pin::JointModelRZ(), pin::SE3(R, p), "joint" + std::to_string(j));
    model.appendBodyToJoint(parent, pin::Inertia::FromDynamicParameters(phi), pin::SE3::Identity());
  }
  pin::Data data(model);
  std::vector<Eigen::VectorXd> q, qd, qdd;
  for (int i = 0; i < samples; ++i) {
    q.push_back(3.0 * Eigen::VectorXd::Random(dof));
    qd.push_back(2.0 * Eigen::VectorXd::Random(dof));
    qdd.push_back(5.0 * Eigen::VectorXd::Random(dof));
  }
  // Made once: no heap within the loop.
  Eigen::MatrixXd by_q = Eigen::MatrixXd::Zero(dof, dof), by_qd = by_q, by_last = by_q;
  double sum = 0;  // read and printed, so that nothing is left out
  const double inverse = nanoseconds(samples, [&](int i) {
    pin::computeRNEADerivatives(model, data, q[i], qd[i], qdd[i], by_q, by_qd, by_last);
    sum += by_q(0, dof - 1);
  });
  const double forward = nanoseconds(samples, [&](int i) {
    pin::computeABADerivatives(model, data, q[i], qd[i], qdd[i], by_q, by_qd, by_last);
    sum += by_q(0, dof - 1);
  });
  std::cout << inverse << " " << forward << " " << sum << std::endl;
}
