// Drives the exported class through the stand-ins: reads commands from standard input, answers each with one line.
//
//   init MODEL GROUP BASE TIP           1 or 0
//   ik POSE SEED                        code q
//   search POSE SEED LIMITS REJECTED    code calls q; LIMITS and REJECTED of -1: the forms without them
//   all POSES POSE.. SEED               error count q..
//   fk LINK Q                           pose, or nothing
//   names                               joints and links
//
// POSE is x y z qx qy qz qw; SEED, Q: six numbers; LIMITS: a number for each joint, the same; REJECTED: how many solutions
// the callback refuses. REJECTED together with `vector` in place of `search`: the form with a vector of poses.
#include <cmath>
#include <fstream>
#include <iostream>

#include "stand_in.hpp"

using kinematics::KinematicsBase;
using Pose = KinematicsBase::Pose;
using Values = KinematicsBase::Values;

// Reads "nan", too, which >> does not.
static double readNumber()
{
  std::string word;
  std::cin >> word;
  return std::stod(word);
}

static Pose readPose()
{
  Pose pose;
  auto& [position, orientation] = pose;
  for (double* value : { &position.x, &position.y, &position.z })
    *value = readNumber();
  for (double* value : { &orientation.x, &orientation.y, &orientation.z, &orientation.w })
    *value = readNumber();
  return pose;
}

static Values readSix()
{
  Values values(6);
  for (double& value : values)
    value = readNumber();
  return values;
}

static void write(const Values& values)
{
  for (double value : values)
    std::cout << ' ' << value;
}

int main()
{
  std::cout.precision(17);
  const std::unique_ptr<KinematicsBase> solver = make_exported();
  std::vector<std::shared_ptr<const moveit::core::RobotModel>> models;
  std::string command;
  while (std::cin >> command)
  {
    KinematicsBase::ErrorCodes error;
    Values solution;
    if (command == "init")
    {
      std::string model, group, base, tip;
      std::cin >> model >> group >> base >> tip;
      std::ifstream file(model);
      models.push_back(std::make_shared<const moveit::core::RobotModel>(file));
#if STAND_IN_MOVEIT == 2
      std::cout << solver->initialize(std::make_shared<rclcpp::Node>(), *models.back(), group, base, { tip }, 0.1);
#else
      std::cout << solver->initialize(*models.back(), group, base, { tip }, 0.1);
#endif
    }
    else if (command == "ik")
    {
      const Pose pose = readPose();
      solver->getPositionIK(pose, readSix(), solution, error);
      std::cout << error.val;
      write(solution);
    }
    else if (command == "search" || command == "vector")
    {
      const Pose pose = readPose();
      const Values seed = readSix();
      double limit;
      int rejected, calls = 0;
      std::cin >> limit >> rejected;
      const Values limits(6, limit);
      const auto callback = [&](const Pose&, const Values&, KinematicsBase::ErrorCodes& verdict) {
        verdict.val = ++calls > rejected ? verdict.SUCCESS : -12;  // GOAL_IN_COLLISION
      };
      if (command == "vector")
        solver->searchPositionIK(std::vector<Pose>{ pose }, seed, 0.1, limits, solution, callback, error);
      else if (limit < 0 && rejected < 0)
        solver->searchPositionIK(pose, seed, 0.1, solution, error);
      else if (limit < 0)
        solver->searchPositionIK(pose, seed, 0.1, solution, callback, error);
      else if (rejected < 0)
        solver->searchPositionIK(pose, seed, 0.1, limits, solution, error);
      else
        solver->searchPositionIK(pose, seed, 0.1, limits, solution, callback, error);
      std::cout << error.val << ' ' << calls;
      write(solution);
    }
    else if (command == "all")
    {
      std::size_t count;
      std::cin >> count;
      std::vector<Pose> poses;
      while (poses.size() < count)
        poses.push_back(readPose());
      std::vector<Values> solutions;
      kinematics::KinematicsResult result;
      solver->getPositionIK(poses, readSix(), solutions, result, kinematics::KinematicsQueryOptions());
      std::cout << result.kinematic_error << ' ' << solutions.size();
      for (const Values& one : solutions)
        write(one);
    }
    else if (command == "fk")
    {
      std::string link;
      std::cin >> link;
      std::vector<Pose> poses;
      solver->getPositionFK({ link }, readSix(), poses);
      for (const auto& [p, o] : poses)
        write({ p.x, p.y, p.z, o.x, o.y, o.z, o.w });
    }
    else if (command == "names")
    {
      for (const std::string& name : solver->getJointNames())
        std::cout << name << ' ';
      for (const std::string& name : solver->getLinkNames())
        std::cout << name << ' ';
    }
    std::cout << std::endl;
  }
}
